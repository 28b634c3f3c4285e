"""The public names: what the pages of docs/reference list, read from the sources without importing them.

`python tests/guards/public_names.py --update` writes the list that the test compares with.
"""

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
SNAPSHOT = Path(__file__).with_name("api_snapshot.txt")


def reference_modules() -> list[str]:
    """Modules that the reference documents."""
    pages = sorted((ROOT / "docs" / "reference").glob("*.md"))
    return sorted({name for page in pages for name in re.findall(r"automodule::\s*(\S+)", page.read_text("utf-8"))})


def module_file(module: str) -> Path:
    """Where a module is written."""
    path = ROOT.joinpath("src", *module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def public_definitions(module: str) -> list[ast.FunctionDef | ast.ClassDef]:
    """Functions and classes of a module whose names do not begin with an underscore."""
    body = ast.parse(module_file(module).read_text("utf-8")).body
    return [n for n in body if isinstance(n, ast.FunctionDef | ast.ClassDef) and not n.name.startswith("_")]


def snapshot() -> str:
    """One line for each public name, with its signature, fields and methods."""
    lines = []
    for module in reference_modules():
        lines.append(module)
        for node in ast.parse(module_file(module).read_text("utf-8")).body:
            lines += [f"    {line}" for line in _described(node)]
    return "\n".join(lines) + "\n"


def _described(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return [target.id for target in targets if isinstance(target, ast.Name) and not target.id.startswith("_")]
    if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
        return [_signature(node)]
    if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
        bases = ", ".join(ast.unparse(base) for base in node.bases)
        return [f"class {node.name}({bases})", *(f"    {line}" for part in node.body for line in _member(part))]
    return []


def _member(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and not node.target.id.startswith("_"):
        return [f"{node.target.id}: {ast.unparse(node.annotation)}"]
    return [] if isinstance(node, ast.Assign) and _hidden(node) else _described(node)


def _hidden(node: ast.Assign) -> bool:
    return any(isinstance(target, ast.Name) and target.id == "model_config" for target in node.targets)


def _signature(node: ast.FunctionDef) -> str:
    marks = "".join(f"@{ast.unparse(mark)} " for mark in node.decorator_list)
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"{marks}{node.name}({ast.unparse(node.args)}){returns}"


if __name__ == "__main__":
    if "--update" in sys.argv:
        SNAPSHOT.write_text(snapshot(), "utf-8")
    else:
        sys.stdout.write(snapshot())
