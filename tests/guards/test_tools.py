"""Style, format, types and layers, as `make lint` checks them."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(module: str, *arguments: str) -> None:
    """Fail with the tool's own words; a tool that is missing is a failure too."""
    if importlib.util.find_spec(module) is None:
        pytest.fail(f"{module} is not installed: pip install -e '.[test]'")
    command = [sys.executable, *arguments]
    environment = {**os.environ, "PYRIGHT_PYTHON_IGNORE_WARNINGS": "1", "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        pytest.fail(f"{module} says:\n{done.stdout[-4000:]}\n{done.stderr[-2000:]}", pytrace=False)


def test_ruff_finds_nothing():
    run("ruff", "-m", "ruff", "check", ".")


def test_the_format_is_ruffs():
    run("ruff", "-m", "ruff", "format", "--check", ".")


def test_types_agree():
    run("pyright", "-m", "pyright", "--pythonpath", sys.executable)


def test_light_only_travels_forward():
    """The contract is in pyproject.toml: a stage imports only stages before it."""
    contract = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    run("importlinter", "-c", contract)
