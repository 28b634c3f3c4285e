"""A design: planes, flux split, pixels, window and rate for a telescope, a star, air and a mirror."""

import math
from dataclasses import dataclass

from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.sampling import SamplingNeed
from nlcwfs.config import Config
from nlcwfs.detector.read import Detector
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.design.blind_frequencies import blind_frequencies
from nlcwfs.simulation.design.loop_errors import LoopErrors, Planes, best_rate_hz, loop_errors
from nlcwfs.simulation.design.loop_residual import Loop, LoopResidual
from nlcwfs.simulation.design.pixel_law import (
    TRIED,
    WINDOWS,
    Choice,
    choices,
    law_of,
    pixels_of,
    window_of,
)
from nlcwfs.simulation.design.plane_information import Pixels, PlaneInformation
from nlcwfs.simulation.design.plane_search import Tell, search_planes
from nlcwfs.simulation.design.requirements import Wishes, check_possible, check_rms, first_rate_hz
from nlcwfs.simulation.exposure import distances_m
from nlcwfs.simulation.starlight import starlight_per_s
from nlcwfs.simulation.steady_light import refuse_colours

MODEL_CELLS_PER_CYCLE = 5.0
"""Cells of the reconstructor's model across the pupil for each cycle of the cutoff (study 08)."""


@dataclass(frozen=True)
class Design:
    """What is proposed, what is expected of it, and what else was looked at.

    Attributes:
        config: Settings ready for the loop.
        modes: Modes of the mirror.
        photons_per_frame: Photo-electrons of the whole sensor in an exposure.
        planes: The planes.
        errors: What they are expected to leave.
        as_set: The same of the planes of the settings, on the same pixels; None if they are not symmetric pairs.
        single: Distances of one pair that got all light, and what it would leave; the nearest first.
        pixels: Detectors of the same window with other pixels, the finest first.
        windows: The same pixels in other windows.
        law: What the sampling law asks for.
        blind_cpa: Waves that the planes do not show on a flat wavefront, cycles per aperture.
        rates: What is left at other rates.
    """

    config: Config
    modes: int
    photons_per_frame: float
    planes: Planes
    errors: LoopErrors
    as_set: tuple[Planes, LoopErrors] | None
    single: tuple[tuple[float, LoopErrors], ...]
    pixels: tuple[Choice, ...]
    windows: tuple[Choice, ...]
    law: SamplingNeed
    blind_cpa: tuple[float, ...]
    rates: tuple[LoopErrors, ...]


def design(config: Config, shape: PupilShape, wishes: Wishes, tell: Tell = lambda line: None) -> Design:
    """Propose a sensor.

    Args:
        config: Telescope, star, air, mirror; its planes are compared with.
        shape: The pupil.
        wishes: What is asked for.
        tell: Called with what is being done.

    Raises:
        SettingsError: If a requirement cannot be met; the message says by how much.
    """
    refuse_colours(config, because="nlcwfs design")
    photons_per_s = starlight_per_s(config)
    if photons_per_s is None:
        rule = "must be given, or atmosphere.photons_per_s: a design needs a star"
        raise SettingsError("atmosphere.star.magnitude", rule, "neither")
    set_planes = planes_as_set(config)
    if wishes.keep_planes and set_planes is None:
        rule = "must be symmetric pairs to be kept (--keep-planes)"
        raise SettingsError("curvature_sensor.distances_km", rule, list(config.curvature_sensor.distances_km))
    tell("modes")
    loop = Loop.of(config, photons_per_s)
    residual = LoopResidual.build(loop, shape)
    rate_hz = first_rate_hz(residual, wishes)
    images = 2 * len(set_planes.distances_m) if wishes.keep_planes and set_planes else wishes.planes
    check_possible(residual, wishes, rate_hz=rate_hz, images=images)
    residual = residual.redrawn(rate_hz=rate_hz, draws=wishes.draws, seed=config.seed)
    across = wishes.pixels or pixels_of(loop)
    dark_share = Detector(config.detector).variance_without_light * images / (loop.photons_per_s / rate_hz)
    information = PlaneInformation(residual, Pixels(across, window_of(across, wishes.window)), dark_share)
    if wishes.keep_planes and set_planes:
        planes = set_planes
    else:
        planes = search_planes(information, pairs=wishes.planes // 2, rate_hz=rate_hz, tell=tell)
    return _completed(config, wishes, information, planes, tell)


def _completed(config: Config, wishes: Wishes, information: PlaneInformation, planes: Planes, tell: Tell) -> Design:
    """Rate, pixels and window for planes that are found."""
    residual, pixels, loop = information.residual, information.pixels, information.residual.loop
    tell("rate")
    rate_hz = wishes.rate_hz or best_rate_hz(information, planes)
    here = {"rate_hz": rate_hz, "dark_share": information.dark_share}
    tell("pixels")
    tried = [pixels_of(loop, part) for part in TRIED] if wishes.pixels is None else [wishes.pixels]
    counts = [Pixels(one, window_of(one, wishes.window)) for one in tried]
    others = choices(residual, planes, pixels=counts, **here)
    tell("windows")
    widths = [Pixels(pixels.across, window_of(pixels.across, one)) for one in WINDOWS]
    errors = loop_errors(information, planes, rate_hz=rate_hz)
    check_rms(residual, errors, wishes)
    set_planes = planes_as_set(config)
    away_m = planes.distances_m
    light = {"wavelength_m": loop.wavelength_m, "diameter_m": loop.diameter_m}
    law = law_of(loop, planes)
    return Design(
        config=proposed(config, planes, pixels, rate_hz=rate_hz, needed_m=law.window_m),
        modes=residual.controlled,
        photons_per_frame=loop.photons_per_s / rate_hz,
        planes=planes,
        errors=errors,
        as_set=set_planes and (set_planes, loop_errors(information, set_planes, rate_hz=rate_hz)),
        single=tuple(
            (one, loop_errors(information, Planes.evenly(one), rate_hz=rate_hz)) for one in information.known_m
        ),
        pixels=tuple(others),
        windows=tuple(choices(residual, planes, pixels=widths, **here)),
        law=law,
        blind_cpa=tuple(blind_frequencies(away_m, up_to=loop.cutoff_cpa, **light)),
        rates=tuple(loop_errors(information, planes, rate_hz=rate_hz * one) for one in (0.5, 0.7, 1.0, 1.4, 2.0)),
    )


def planes_as_set(config: Config) -> Planes | None:
    """The planes of a configuration, if they are symmetric pairs that share their light evenly; else None.

    Examples:
        >>> planes_as_set(Config())
        Planes(distances_m=(2500000.0, 3500000.0), shares=(0.5, 0.5))
    """
    placed, fractions = distances_m(config), config.curvature_sensor.flux_fractions
    light = dict(zip(placed, fractions or (1 / len(placed),) * len(placed), strict=True))
    away = sorted({abs(distance_m) for distance_m in placed})
    if any(not math.isclose(light.get(one, 0.0), light.get(-one, 1.0), rel_tol=1e-6) for one in away):
        return None
    return Planes(tuple(away), tuple(2 * light[one] for one in away))


def proposed(config: Config, planes: Planes, pixels: Pixels, *, rate_hz: float, needed_m: float) -> Config:
    """The settings with planes, pixels and rate in them, ready for `nlcwfs loop`.

    Args:
        config: Telescope, star, air and mirror.
        planes: Symmetric pairs.
        pixels: Of an image.
        rate_hz: Exposures in a second.
        needed_m: Window that holds all light, for the grid of the simulated light.

    Examples:
        >>> made = proposed(Config(), Planes.evenly(2e6), Pixels(30, 44), rate_hz=300.0, needed_m=15.0)
        >>> made.curvature_sensor.distances_km, made.detector.window_pixels, made.simulation.light_oversampling
        ((-2000.0, 2000.0), 44, 6)
    """
    pairs = sorted(zip(planes.distances_m, planes.shares, strict=True), reverse=True)
    both = [(-far, share) for far, share in pairs] + [(far, share) for far, share in reversed(pairs)]
    even = len({share for _, share in pairs}) == 1
    cycles = Loop.of(config, 1.0).cutoff_cpa
    model = max(2, math.ceil(round(MODEL_CELLS_PER_CYCLE * cycles / pixels.across, 6)))
    window_m = config.beam.diameter_m * pixels.window / pixels.across
    seeing = config.atmosphere.seeing_arcsec if config.atmosphere.opd_rms_nm is None else None
    changes = {
        "curvature_sensor": {
            "distances_km": tuple(round(far_m / 1e3, 6) for far_m, _ in both),
            "flux_fractions": None if even else tuple(share / 2 for _, share in both),
        },
        "detector": {"pixels_across_pupil": pixels.across, "window_pixels": pixels.window},
        "estimation": {
            "modes": min(config.estimation.modes, 100),
            "seeing_arcsec": config.estimation.seeing_arcsec or seeing,
            "map": config.estimation.map.model_copy(update={"oversampling": model}),
        },
        "loop": {"rate_hz": rate_hz},
        "simulation": {
            "light_oversampling": model * max(1, math.ceil(4 / model)),
            "light_window": min(16.0, max(1.0, math.ceil(10 * needed_m / window_m) / 10)),
        },
    }
    sections = {name: getattr(config, name).model_copy(update=change) for name, change in changes.items()}
    return config.model_copy(update=sections)
