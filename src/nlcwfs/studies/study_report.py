"""The page of a study, written from its table: the answer first, then the rows, a table for each group."""

from pathlib import Path

from nlcwfs.interop import atomic_write
from nlcwfs.studies.study_cases import Study
from nlcwfs.studies.study_table import Row, StudyTable

COLUMNS = {
    "case": ("case", "{}"),
    "D/r0": ("telescope_over_fried", "{:.1f}"),
    "photons": ("photons", "{:.0e}"),
    "pixels": ("pixels", "{}"),
    "light": ("light", "{}"),
    "screens": ("screens", "{}"),
    "captured": ("captured", "{:.1%}"),
    "median [nm]": ("median_nm", "{:.1f}"),
    "5 to 95 % [nm]": (("p5_nm", "p95_nm"), "{:.1f} to {:.1f}"),
    "median of captured [nm]": ("median_captured_nm", "{:.1f}"),
    "FFTs": ("ffts", "{:.0f}"),
    "predicted [nm]": ("predicted_nm", "{:.1f}"),
    "believed wrong": ("believed_wrong", "{:.1%}"),
    "doubted right": ("doubted_right", "{:.1%}"),
    "bound [nm]": ("bound_nm", "{:.1f}"),
    "quantum limit [nm]": ("quantum_nm", "{:.1f}"),
}


def write_report(folder: Path, study: Study, table: StudyTable, pictures: dict[str, str]) -> Path:
    """Write `README.md` beside the table.

    Args:
        folder: Of the study.
        study: Its question and answer.
        table: Its rows.
        pictures: Caption of each picture, by file name.
    """
    lines = [f"# {study.answer}", "", study.question, ""]
    lines += [f"![{caption}]({name})\n\n*{caption}*\n" for name, caption in pictures.items()]
    for group, heading in study.groups.items():
        rows = [row for row in table.rows if row["group"] == group]
        if rows:
            lines += [f"## {heading}", "", *_table(rows), ""]
    lines += [study.notes.strip(), ""]
    path = folder / "README.md"
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")
    return path


def _table(rows: list[Row]) -> list[str]:
    """Markdown; a column without a number in any row is left out."""
    cells = {title: [_cell(row, keys, form) for row in rows] for title, (keys, form) in COLUMNS.items()}
    kept = {title: column for title, column in cells.items() if any(column)}
    head = "| " + " | ".join(kept) + " |"
    rule = "|" + "---|" * len(kept)
    return [head, rule, *("| " + " | ".join(row) + " |" for row in zip(*kept.values(), strict=True))]


def _cell(row: Row, keys: str | tuple[str, ...], form: str) -> str:
    values = [row[key] for key in ((keys,) if isinstance(keys, str) else keys)]
    if any(isinstance(value, float) and value != value for value in values):
        return ""
    return form.format(*values)
