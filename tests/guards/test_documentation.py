"""The code of the documentation runs and prints what the pages say."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RUNNER = Path(__file__).with_name("page_code.py")


@pytest.mark.parametrize(
    "page", ["README.md", "docs/tutorial.md", "docs/your-own-frames.md", "docs/sampling.md", "docs/colour.md"]
)
def test_the_code_of_a_page_runs_and_prints_what_it_says(page, tmp_path):
    command = [sys.executable, str(RUNNER), str(ROOT / page)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
