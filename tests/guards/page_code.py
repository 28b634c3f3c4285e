"""Run the code of a page of the documentation, in its order, in the present folder: `page_code.py PAGE.md`.

`python` blocks share their names; a `text` block behind one is what it prints. A `toml` block with a caption is
written to the file of that name. Lines of a `console` block that start with `$ nlcwfs` are run; the rest of the block
is what they print, compared without digits. `...` stands for anything. Lines of an `sh` block that start with `nlcwfs`
are run.
"""

import contextlib
import doctest
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

FENCE = re.compile(r"^(`{3,})(\S[^\n]*)\n(.*?)^\1$", re.MULTILINE | re.DOTALL)
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def same(wanted: str, got: str) -> bool:
    """Whether two texts agree, `...` being anything."""
    return doctest.OutputChecker().check_output(wanted.strip() + "\n", got.strip() + "\n", FLAGS)


def without_digits(text: str) -> str:
    """Times and noise differ between machines."""
    return re.sub(r"less than #|#(\.#)?", "#", re.sub(r"\d+", "#", text))


def run_console(block: str) -> None:
    """Run the commands of a block; 1, a wavefront that is not believed, is for the page to explain."""
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, _, wanted = part.partition("\n")
        name, *arguments = shlex.split(command, comments=True)
        if name != "nlcwfs":
            raise SystemExit(f"only nlcwfs is run, not: {command}")
        done = subprocess.run([sys.executable, "-m", "nlcwfs.cli", *arguments], capture_output=True, text=True)
        if done.returncode not in (0, 1):
            raise SystemExit(f"{command}\nexit code {done.returncode}\n{done.stderr}")
        if not same(without_digits(wanted), without_digits(done.stdout)):
            raise SystemExit(f"{command}\nprints\n{done.stdout}\nnot\n{wanted}")


def run_page(page: Path) -> None:
    """Run every block of a page."""
    names: dict[str, object] = {"__name__": "page"}
    printed = ""
    for _, language, block in FENCE.findall(page.read_text()):
        if language == "python":
            with contextlib.redirect_stdout(io.StringIO()) as output:
                exec(compile(block, str(page), "exec"), names)
            printed = output.getvalue()
        elif language == "text" and printed:
            if not same(block, printed):
                raise SystemExit(f"prints\n{printed}\nnot\n{block}")
            printed = ""
        elif language == "console":
            run_console(block)
        elif language == "sh":
            run_console("".join(f"$ {line}\n...\n" for line in block.splitlines() if line.startswith("nlcwfs ")))
        elif language.startswith("{code-block} toml"):
            caption, _, text = block.partition("\n\n")
            Path(caption.removeprefix(":caption:").strip()).write_text(text)


if __name__ == "__main__":
    run_page(Path(sys.argv[1]))
