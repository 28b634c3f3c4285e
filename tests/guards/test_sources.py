"""What every source file promises: small, silent, without side effects, documented, free of anybody's machine."""

import ast
import re
import subprocess
from pathlib import Path

import pytest
from public_names import module_file, public_definitions, reference_modules

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "nlcwfs"
SOURCES = sorted(PACKAGE.rglob("*.py"))
NAMES = [str(path.relative_to(PACKAGE)) for path in SOURCES]

LONGEST_FILE = 300
LONGEST_FUNCTION = 50  # lines, the docstring not counted
MOST_PARAMETERS = 6

LONG_FUNCTIONS = {
    "estimation/ladder.py:_level": "one call that fills the sixteen fields of a level",
}
MANY_PARAMETERS = {
    "curvature_sensor/defocused_images.py:build": "the eight things a sensor is made of, five of them optional",
    "estimation/amplitude_constraint.py:modulus_factor": "noise, doubt and a mean known already are options",
    "estimation/ladder.py:_level": "fills a record; private",
    "estimation/gerchberg_saxton.py:problem_at": "fills a record",
}
SELF_EVIDENT = 8  # lines: a function so short is its own example
WITHOUT_EXAMPLE = {
    "nlcwfs.beam.sampling_cost:window_costs": "its example is that of the estimate it belongs to",
    "nlcwfs.beam.sampling_cost:pixel_error": "the same",
    "nlcwfs.estimation.first_guess:with_strength": "needs a sensor and its light; `MaximumAPosteriori` shows it",
    "nlcwfs.estimation.first_guess:segmented_start": "the same",
    "nlcwfs.estimation.gauss_newton:step": "needs a sensor; `MaximumAPosteriori` shows what steps lead to",
    "nlcwfs.estimation.gauss_newton:direction_of_step": "the same",
    "nlcwfs.estimation.flow_filter:modal_information": "needs a sensor and its light",
    "nlcwfs.simulation.closed_loop.sensor:build_sensor": "needs a loop's light; `nlcwfs loop` shows it",
    "nlcwfs.simulation.closed_loop.air:learnt_air": "needs a loop's telemetry; `nlcwfs loop` shows it",
    "nlcwfs.simulation.closed_loop.flow:carried_curvature": "the same",
    "nlcwfs.simulation.closed_loop.flow:mirror_modes": "the same",
    "nlcwfs.simulation.closed_loop.flow:settled_filter": "the same",
    "nlcwfs.simulation.closed_loop.flow:seen_information": "the same",
    "nlcwfs.simulation.closed_loop.spots_air:carried_spots": "the same",
    "nlcwfs.simulation.closed_loop.spots_air:finer_rad2": "the same",
    "nlcwfs.simulation.closed_loop.spots_air:coarser": "the same",
    "nlcwfs.estimation.turn_islands:torn_phase": "needs a sensor and its light",
    "nlcwfs.estimation.segment_light:interference": "needs a sensor of segments and its light",
    "nlcwfs.estimation.segment_turns:looked": "the same",
    "nlcwfs.interop.frames_fits:write_frames": "needs a folder; docs/your-own-frames.md shows it",
    "nlcwfs.interop.wavefront_fits:read_wavefront": "needs a file; the example is that of writing",
    "nlcwfs.interop.loop_folder:prepare_folder": "needs a folder; `nlcwfs loop` shows it",
    "nlcwfs.interop.loop_folder:read_checkpoint": "needs a run of the loop",
    "nlcwfs.interop.loop_folder:write_image": "needs a run of the loop",
    "nlcwfs.interop.loop_folder:write_telemetry": "needs a run of the loop",
    "nlcwfs.interop.loop_folder:write_records": "needs a run of the loop",
    "nlcwfs.interop.loop_sensor_aot:aot_sensor": "needs a loop",
    "nlcwfs.simulation.closed_loop.lenslet_modes:slopes_of_cells": "needs the optics of a loop",
    "nlcwfs.simulation.closed_loop.loop_waves:waves_between": "needs a loop's light",
    "nlcwfs.simulation.closed_loop.loop_waves:loop_waves": "the same",
    "nlcwfs.simulation.closed_loop.image_light:residual_structure": "the same",
    "nlcwfs.simulation.closed_loop.linear_images:handed_over": "the same",
    "nlcwfs.simulation.closed_loop.linear_images:within_range": "the same",
    "nlcwfs.estimation.image_matrix:image_matrix": "needs a sensor's images; docs/linear-regime.md shows it in a loop",
    "nlcwfs.simulation.known_sensor:geometry_of": "needs a whole configuration",
    "nlcwfs.simulation.closed_loop.pyramid_light:pyramid_on": "needs the light of a loop",
    "nlcwfs.simulation.closed_loop.pyramid_regimes:pyramid_regimes": "the same",
    "nlcwfs.simulation.static_aberration:static_aberration": "needs a whole configuration",
    "nlcwfs.simulation.closed_loop.faults:damaged": "needs an exposure",
    "nlcwfs.simulation.closed_loop.run:run_loop": "needs a loop, and seconds; docs/closed-loop.md shows it",
    "nlcwfs.simulation.closed_loop.run:summary": "needs a run of the loop",
    "nlcwfs.simulation.closed_loop.run:loop_bounds": "needs a loop",
    "nlcwfs.simulation.design.design:design": "half a minute; `nlcwfs design` and docs/design.md show it",
    "nlcwfs.studies.design_picture:draw_design": "needs a design",
    "nlcwfs.studies.contrast_loop:measured_flux_factor": "needs a loop that has run",
    "nlcwfs.studies.contrast_loop:loop_rows": "the same",
    "nlcwfs.studies.contrast_report:write_report": "needs a folder; `nlcwfs contrast` shows it",
    "nlcwfs.studies.sensitivity_run:run_curve": "needs a table on disk, and seconds; docs/sensitivity.md shows it",
    "nlcwfs.studies.sensitivity_figure:draw_sensitivity": "needs a table of curves",
    "nlcwfs.studies.sensitivity_figure:write_sensitivity_page": "needs a table of curves",
    "nlcwfs.studies.sweep_points:read_sweep": "needs a file; docs/sweeps.md shows it",
    "nlcwfs.studies.sweep_cluster:connected": "needs a scheduler; docs/sweeps.md shows it",
    "nlcwfs.studies.sweep_run:run_sweep": "needs workers, and minutes",
    "nlcwfs.studies.sweep_report:write_sweep_report": "needs a table",
    "nlcwfs.studies.study_cases:read_study": "needs a folder; `nlcwfs study` shows it",
    "nlcwfs.studies.case_run:build_solver": "needs a study",
    "nlcwfs.studies.case_run:run_case": "needs a study",
    "nlcwfs.studies.study_light:make_light": "needs a study",
    "nlcwfs.studies.study_run:run_study": "needs a folder, and minutes",
}


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def functions(path: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(tree(path)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def label(path: Path, function: ast.FunctionDef | ast.AsyncFunctionDef) -> str:
    return f"{path.relative_to(PACKAGE)}:{function.name}"


def length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines without the docstring."""
    first = function.body[0]
    documented = ast.get_docstring(function) is not None
    return function.end_lineno - function.lineno + 1 - (first.end_lineno - first.lineno + 1 if documented else 0)


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    given = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return len([one for one in given if one.arg not in ("self", "cls")])


def test_there_are_sources():
    assert len(SOURCES) > 40  # else every other guard would pass on nothing


@pytest.mark.parametrize("path", SOURCES, ids=NAMES)
def test_a_file_is_small_enough_to_be_about_one_thing(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= LONGEST_FILE


def test_a_function_fits_on_a_page():
    long = {label(path, one): length(one) for path in SOURCES for one in functions(path)}
    long = {name: lines for name, lines in long.items() if lines > LONGEST_FUNCTION}
    assert set(long) == set(LONG_FUNCTIONS), f"split them, or give a reason; or drop one that is no longer long: {long}"


def test_records_beat_long_lists_of_parameters():
    """The command line is exempt: there every parameter is an option that the user reads."""
    library = [path for path in SOURCES if path.name != "cli.py"]
    many = {label(path, one): parameters(one) for path in library for one in functions(path)}
    many = {name: count for name, count in many.items() if count > MOST_PARAMETERS}
    assert set(many) == set(MANY_PARAMETERS), f"make a record, or give a reason; or drop one that is gone: {many}"


@pytest.mark.parametrize("path", SOURCES, ids=NAMES)
def test_libraries_return_and_do_not_print(path):
    if path.name == "cli.py" or PACKAGE / "commands" in path.parents:
        return  # the command line is where printing belongs
    calls = [node.func for node in ast.walk(tree(path)) if isinstance(node, ast.Call)]
    assert not [call for call in calls if isinstance(call, ast.Name) and call.id in ("print", "input", "breakpoint")]


@pytest.mark.parametrize("path", SOURCES, ids=NAMES)
def test_errors_are_raised_and_not_asserted(path):
    assert not [node.lineno for node in ast.walk(tree(path)) if isinstance(node, ast.Assert)]


def at_import(body: list[ast.stmt]) -> list[ast.stmt]:
    """Statements that run when a module is imported, those inside classes and conditions included."""
    found = []
    for node in body:
        if isinstance(node, ast.If) and "__name__" in ast.unparse(node.test):
            continue
        found.append(node)
        if isinstance(node, ast.ClassDef | ast.If | ast.With | ast.For | ast.Try):
            found += at_import(node.body + getattr(node, "orelse", []))
    return found


@pytest.mark.parametrize("path", SOURCES, ids=NAMES)
def test_importing_changes_nothing(path):
    """No precision, device or warning filter is set for the user, and nothing is called but to make a constant."""
    for node in at_import(tree(path).body):
        source = ast.unparse(node).splitlines()[0]
        assert not re.search(r"\b(jax\.config|config\.update|os\.environ|filterwarnings|basicConfig)\b", source), source
        docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        assert docstring or not isinstance(node, ast.Expr | ast.Delete | ast.For | ast.While | ast.Global), source


@pytest.mark.parametrize("path", SOURCES, ids=NAMES)
def test_nothing_is_overridden_or_asked_whether_it_is_there(path):
    names = [
        node.func.id for node in ast.walk(tree(path)) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    ]
    if path.name == "errors.py":
        names = [name for name in names if name != "super"]  # an exception must hand its message on
    assert not {"super", "hasattr", "exec", "eval"} & set(names)
    stars = [node for node in ast.walk(tree(path)) if isinstance(node, ast.ImportFrom) and node.names[0].name == "*"]
    assert not stars


@pytest.mark.parametrize("module", reference_modules())
def test_what_is_public_explains_itself_by_an_example(module):
    """A record of fields is explained by them, an exception by its sentence; a function shows what it does."""
    for node in public_definitions(module):
        docstring = ast.get_docstring(node)
        assert docstring, f"{module}.{node.name} has no docstring"
        if isinstance(node, ast.FunctionDef):
            shown = "Examples:" in docstring or length(node) <= SELF_EVIDENT
            exempt = f"{module}:{node.name}" in WITHOUT_EXAMPLE
            assert shown != exempt, f"{module}.{node.name}: an example, or a reason why not"


def test_the_reasons_are_about_functions_that_exist():
    there = {f"{module}:{node.name}" for module in reference_modules() for node in public_definitions(module)}
    assert set(WITHOUT_EXAMPLE) <= there


def test_the_reference_lists_modules_that_exist():
    assert len(reference_modules()) > 30
    assert not [module for module in reference_modules() if not module_file(module).exists()]


# ------------------------------------------------------------------------------------------ the repository


def repository_texts() -> list[Path]:
    """Text files under version control."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode:  # an unpacked release
        return [path for folder in ("src", "tests", "docs") for path in sorted((ROOT / folder).rglob("*.[mpt][dyo]*"))]
    found = [ROOT / name for name in listed.stdout.decode().split("\0") if name]
    return [path for path in found if path.is_file() and b"\0" not in path.read_bytes()[:8000]]


SOMEBODYS_MACHINE = re.compile(
    r"(?<![\w.~-])/(?:home|work|tmp|Users|opt|root|scratch)/\w"  # an absolute path of a machine
    r"|\.\./"
    r"shared"
    r"|(?:extra-)?index"
    r"-url|find"
    r"-links|trusted"
    r"-host"  # where somebody's packages come from
    r"|https?://(?:localhost|\d+\.\d+\.\d+\.\d+|[\w.-]+\.(?:local|internal|lan|corp))\b"
)


def test_no_file_knows_the_machine_it_was_written_on():
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}"
        for path in repository_texts()
        for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1)
        if SOMEBODYS_MACHINE.search(line)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("see /ho" + "me/ann/x", True),
        ("../" + "shared/a.md", True),
        ("http://" + "10.0.0.7:80/", True),
        ("https://docs.example.org/work/a and docs/work/a", False),
    ],
)
def test_the_search_for_machines_finds_them(text, known):
    assert bool(SOMEBODYS_MACHINE.search(text)) == known


def test_each_of_the_nine_conventions_has_its_page():
    """design: units, OPD, (y, x), sign of z, photons, Zernikes, randomness, no inverse crime, scores."""
    pages = {path.name[:2]: path for path in (ROOT / "docs" / "decisions").glob("[0-9][0-9]-*.md")}
    index = (ROOT / "docs" / "decisions" / "index.md").read_text(encoding="utf-8")
    for number in range(1, 10):
        page = pages[f"{number:02d}"]
        text = page.read_text(encoding="utf-8")
        assert text.startswith("# ")
        assert len(text.split()) > 100, f"{page.name}: half a page of reasons"
        assert page.stem in index
