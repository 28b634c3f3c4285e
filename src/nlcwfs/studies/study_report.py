"""The page of a study, written from its table: the answer first, then the rows, a table for each group."""

import math
from pathlib import Path

from nlcwfs.interop import atomic_write
from nlcwfs.studies.study_cases import Study
from nlcwfs.studies.study_table import Row, StudyTable

Column = tuple[str | tuple[str, ...], str]
"""Keys of the table, and how they are written."""

SKY: dict[str, Column] = {
    "case": ("case", "{}"),
    "D/r0": ("telescope_over_fried", "{:.1f}"),
    "photons": ("photons", "{:.0e}"),
    "pixels": ("pixels", "{}"),
}

COLUMNS: dict[str, dict[str, Column]] = {
    "fine": SKY
    | {
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
    },
    "pixels": SKY
    | {
        "band": ("band", "{:.0%}"),
        "lenses": ("lenses", "{}"),
        "wavelengths of the light": ("light_colours", "{:.0f}"),
        "of the model": ("model_colours", "{:.0f}"),
        "star [mas]": ("star_mas", "{:g}"),
        "dispersion [mas rms]": ("dispersion_mas", "{:.2f}"),
        "index": ("index", "{:.3f}"),
        "screens": ("screens", "{}"),
        "captured": ("captured_pixels", "{:.1%}"),
        "median [nm]": ("median_pixels_nm", "{:.1f}"),
        "95 % [nm]": ("p95_pixels_nm", "{:.1f}"),
        "fine [nm]": ("median_nm", "{:.1f}"),
        "FFTs": ("ffts", "{:.0f}"),
        "FFTs, 95 %": ("ffts_p95", "{:.0f}"),
        "ms": ("ms_per_frame", "{:.0f}"),
        "believed wrong": ("believed_wrong", "{:.1%}"),
        "doubted right": ("doubted_right", "{:.1%}"),
        "error over predicted": ("error_over_predicted", "{:.2f}"),
        "low / middle / high": (
            ("error_over_predicted_low", "error_over_predicted_middle", "error_over_predicted_high"),
            "{:.2f} / {:.2f} / {:.2f}",
        ),
        "bound [nm]": ("bound_pixels_nm", "{:.1f}"),
        "quantum limit [nm]": ("quantum_pixels_nm", "{:.1f}"),
        "closed form adds [nm]": ("added_nm", "{:.1f}"),
    },
    "segments": SKY
    | {
        "screens": ("screens", "{}"),
        "piston [nm]": ("piston_modulo_nm", "{:.2f}"),
        "worst": ("piston_modulo_worst_nm", "{:.1f}"),
        "inside [nm]": ("inside_nm", "{:.1f}"),
        "worst inside": ("inside_worst_nm", "{:.1f}"),
        "straightened [nm]": ("straightened_nm", "{:.1f}"),
        "captured": ("captured_steps", "{:.0%}"),
        "right turns": ("right_turns", "{:.0%}"),
        "FFTs": ("ffts", "{:.0f}"),
        "ms": ("ms_per_frame", "{:.0f}"),
        "believed wrong": ("believed_wrong", "{:.0%}"),
        "doubted right": ("doubted_right", "{:.0%}"),
    },
    "turns": SKY
    | {
        "trials": ("screens", "{}"),
        "right": ("turns_right", "{:.1%}"),
        "95 %": (("turns_right_low", "turns_right_high"), "{:.1%} to {:.1%}"),
        "told wrong": ("told_wrong", "{:.2g}"),
        "told of wrong, least": ("told_of_wrong_least", "{:.2g}"),
        "told of right, median": ("told_of_right_median", "{:.1g}"),
        "piston [nm]": ("piston_modulo_nm", "{:.1f}"),
        "inside [nm]": ("inside_nm", "{:.1f}"),
        "FFTs": ("ffts", "{:.0f}"),
        "ms": ("ms_per_frame", "{:.0f}"),
    },
}
"""Columns of the page, by title, for each score of `Capture`."""

QUICK = {
    "fine": ("captured", "median_nm"),
    "pixels": ("captured_pixels", "median_pixels_nm"),
    "segments": ("captured_steps", "piston_modulo_nm"),
    "turns": ("right_turns", "piston_modulo_nm"),
}
"""What a quick look tells, for each score."""


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
            lines += [f"## {heading}", "", *markdown_table(rows, COLUMNS[study.score]), ""]
    lines += [study.notes.strip(), ""]
    path = folder / "README.md"
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")
    return path


def quick_lines(study: Study, table: StudyTable, only: tuple[str, ...]) -> list[str]:
    """What a quick look found: a line for each case, in the order of the study."""
    captured, error = QUICK[study.score]
    rows = {str(row["case"]): row for row in table.rows}
    names = [case.name for case in study.case if case.name in rows and (not only or case.name.startswith(only))]
    return [
        f"{name}: {rows[name][captured]:.0%} of {rows[name]['screens']} captured, median {rows[name][error]:.1f} nm, "
        f"{rows[name]['ffts']:.0f} FFTs, {rows[name].get('ms_per_frame', math.nan):.0f} ms"
        for name in names
    ]


def markdown_table(rows: list[Row], columns: dict[str, Column]) -> list[str]:
    """Markdown; a column without a number in any row is left out."""
    cells = {title: [_cell(row, keys, form) for row in rows] for title, (keys, form) in columns.items()}
    kept = {title: column for title, column in cells.items() if any(column)}
    head = "| " + " | ".join(kept) + " |"
    rule = "|" + "---|" * len(kept)
    return [head, rule, *("| " + " | ".join(row) + " |" for row in zip(*kept.values(), strict=True))]


def _cell(row: Row, keys: str | tuple[str, ...], form: str) -> str:
    values = [row.get(key, "") for key in ((keys,) if isinstance(keys, str) else keys)]
    if any(isinstance(value, str) and not value for value in values):
        return ""
    if any(isinstance(value, float) and value != value for value in values):
        return ""
    return form.format(*values)
