"""Makes parts of the documentation out of studies and settings, so that each stands in one place only."""

from pathlib import Path

import typer
from typer.testing import CliRunner

from nlcwfs.cli import app
from nlcwfs.config import default_toml

STUDIES = (
    "01-single-frame",
    "02-every-method",
    "03-closed-loop",
    "04-faint-stars",
    "05-fewer-planes",
    "06-sensitivity",
    "07-contrast",
    "08-planes-and-pixels",
    "09-one-family",
    "10-colour-loop",
    "11-sparse-pupil",
    "12-whole-wavelengths",
    "13-no-chromatic-lenses",
    "14-sky-budgets",
    "15-any-pupil",
    "16-loop-on-the-sky",
)
PENDING = "The table of this study is not stored yet: `make studies` computes it.\n"


def write_pages(docs: Path) -> None:
    """Copy the README of each study, one heading level lower, with its pictures, to where a page includes it.

    A study that is not stored yet becomes a sentence that says so.
    """
    for name in STUDIES:
        folder = docs.parent / "studies" / name
        readme = folder / "README.md"
        text = _lowered(readme.read_text(encoding="utf-8")) if readme.exists() else PENDING
        for picture in sorted(folder.glob("*.png")):
            kept = f"study-{name}-{picture.name}"
            _write(docs / "_generated" / kept, picture.read_bytes())
            text = text.replace(f"]({picture.name})", f"](_generated/{kept})")
        _write(docs / "_generated" / f"study-{name}.md", text)


def write_settings(docs: Path) -> None:
    """Write every setting under its comment, and the part of it that rules the reconstruction."""
    everything = default_toml()
    _write(docs / "_generated" / "default.toml", everything)
    blocks = everything.split("\n\n")
    first = next(number for number, block in enumerate(blocks) if "\n[estimation]" in f"\n{block}")
    last = next(number for number, block in enumerate(blocks) if "\n[simulation]" in f"\n{block}")
    _write(docs / "_generated" / "estimation.toml", "\n\n".join(blocks[first:last]) + "\n")


def write_command_line(docs: Path) -> None:
    """Write the help of every command, as it is typed."""
    wide = {"COLUMNS": "110", "TERMINAL_WIDTH": "110", "NO_COLOR": "1", "TERM": "dumb"}
    parts = []
    for name in ["", *typer.main.get_command(app).commands]:  # pyright: ignore
        words = ["nlcwfs", name, "--help"] if name else ["nlcwfs", "--help"]
        shown = CliRunner().invoke(app, words[1:], env=wide, prog_name="nlcwfs").output
        body = "\n".join(line.rstrip() for line in shown.strip().splitlines())
        parts.append(f"## `{' '.join(words[:-1])}`\n\n```text\n{body}\n```\n")
    _write(docs / "_generated" / "command-line.md", "\n".join(parts))


def _write(target: Path, content: str | bytes) -> None:
    data = content.encode() if isinstance(content, str) else content
    target.parent.mkdir(exist_ok=True)
    if not target.exists() or target.read_bytes() != data:  # an unchanged page is not built again
        target.write_bytes(data)


def _lowered(text: str) -> str:
    lines, in_code = [], False
    for line in text.splitlines():
        in_code ^= line.startswith("```")
        lines.append(f"#{line}" if line.startswith("#") and not in_code else line)
    return "\n".join(lines) + "\n"
