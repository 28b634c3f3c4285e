"""Running a study: for every case, many screens through light, detector and reconstructor, scored on the fine grid."""

import hashlib
import json
import math
from pathlib import Path

import jax

from nlcwfs.config import Config
from nlcwfs.interop import Provenance
from nlcwfs.studies.case_bound import LightInformation, case_bound, light_information
from nlcwfs.studies.case_run import run_case
from nlcwfs.studies.colour_columns import colour_columns
from nlcwfs.studies.sky_columns import sky_columns
from nlcwfs.studies.study_cases import Case, Study, read_study
from nlcwfs.studies.study_light import Light, Progress, light_kind, make_light
from nlcwfs.studies.study_table import Row, StudyTable

BOUND_COLUMNS = ("bound_nm", "quantum_nm", "bound_pixels_nm", "quantum_pixels_nm", "sensor_loss")


def run_study(
    folder: Path, *, progress: Progress, only: tuple[str, ...] = (), screens: int | None = None
) -> StudyTable:
    """Run what the table of a study does not hold yet.

    Args:
        folder: Holds `study.toml`; the table goes beside it.
        progress: Called after each screen.
        only: Run only the cases whose names start so.
        screens: Replaces the number of screens, for a quick look, which has a table of its own.

    Returns:
        The table, also on disk as `results.ecsv`; that of a quick look as `quick.ecsv`.

    Raises:
        FileFormatError: If the study's file is missing or wrong, a case in it is impossible, or the table is damaged.
        SamplingError: If the pupil of a case does not fit on its frames.
    """
    study = read_study(folder)
    configs = study.configs(folder / "study.toml")
    table = StudyTable(table_path(folder, screens))
    seeds = {config.seed for config in configs.values()}
    seed = seeds.pop() if len(seeds) == 1 else None  # cases may each have their own: it is in their settings
    stamp = Provenance.collect(study.model_dump(mode="json"), seed=seed, device=jax.devices()[0].device_kind)
    lights: dict[str, tuple[int, Light]] = {}
    bounds: dict[str, LightInformation] = {}
    for case in study.case:
        if only and not case.name.startswith(only):
            continue
        config, count = configs[case.name], screens or study.screens_of(case)
        digest = case_digest(study, case, config, count)
        if table.holds(case.name, digest):
            continue
        kind = light_kind(case, config)
        if kind not in lights or lights[kind][0] < count:
            lights.clear()  # one kind at a time: memory
            lights[kind] = count, make_light(case, config, count, progress, air=study.air_of(case))
        row = run_case(case, config, study.capture, lights[kind][1].first(count), progress)
        row |= colour_columns(config) | sky_columns(config, study.air_of(case))
        row |= _bound_columns(case, config, bounds)
        table.put({"case": case.name, "group": case.group} | row | {"commit": stamp.commit, "digest": digest}, stamp)
    if not only and table.rows:
        table.sort([case.name for case in study.case], stamp)
    return table


def table_path(folder: Path, screens: int | None) -> Path:
    """The table of a study, or that of quick looks at it, which no repository keeps.

    Examples:
        >>> table_path(Path("studies/01-single-frame"), None).name, table_path(Path("."), 2).name
        ('results.ecsv', 'quick.ecsv')
    """
    return folder / ("results.ecsv" if screens is None else "quick.ecsv")


def case_digest(study: Study, case: Case, config: Config, count: int) -> str:
    """What a row is the answer to: all that the case and its settings say, beyond the defaults.

    A setting that is new and left at its default makes no stored row stale. A default that changes does not either:
    who changes one says in the study what its rows were computed with.
    """
    told = [case.model_dump(mode="json", exclude_defaults=True), config.model_dump(mode="json", exclude_defaults=True)]
    capture = study.capture._asdict() if study.score != "fine" else {"captured_nm": study.captured_nm}
    content = json.dumps([*told, count, capture], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def _bound_columns(case: Case, config: Config, known: dict[str, LightInformation]) -> Row:
    if not case.bound:
        return dict.fromkeys(BOUND_COLUMNS, math.nan)
    same = config.atmosphere.model_copy(update={"photons": 1.0})
    key = light_kind(case, config.model_copy(update={"atmosphere": same}))
    if key not in known:
        known.clear()
        known[key] = light_information(config)
    return dict(case_bound(config, known[key]))
