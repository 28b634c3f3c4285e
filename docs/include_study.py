"""Makes pages of the documentation out of the stored studies, so that a number stands in one place only."""

from pathlib import Path

STUDIES = ("01-single-frame",)
PENDING = "The table of this study is not stored yet: `make studies` computes it.\n"


def write_pages(docs: Path) -> None:
    """Copy the README of each study, one heading level lower, to where a page of the docs includes it.

    A study that is not stored yet becomes a sentence that says so. Pictures are left out: they stand in the
    study's own folder.
    """
    folder = docs / "_generated"
    folder.mkdir(exist_ok=True)
    for name in STUDIES:
        readme = docs.parent / "studies" / name / "README.md"
        text = _lowered(readme.read_text()) if readme.exists() else PENDING
        target = folder / f"study-{name}.md"
        if not target.exists() or target.read_text() != text:  # an unchanged page is not built again
            target.write_text(text)


def _lowered(text: str) -> str:
    lines, in_code = [], False
    for line in text.splitlines():
        in_code ^= line.startswith("```")
        if line.startswith("![") and not in_code:
            continue
        lines.append(f"#{line}" if line.startswith("#") and not in_code else line)
    return "\n".join(lines) + "\n"
