"""Which frames can be used: rules about their pixels, and what is told about those that bend them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

LOST_LIMIT = 0.1
"""A frame with more than this share of its pixels NaN, infinite or saturated is refused."""

NEGATIVE_SIGMA = 5.0
"""Noise does not reach this far below zero: 3e-7 of the pixels of a normal distribution do."""

NEGATIVE_LIMIT = 0.1
"""A frame with more than this share of its pixels below that is refused."""

FAINT_SIGMA = 3.0
"""Light of a whole frame, or of a plane that is far too dark, counts when it is this far above its noise."""

PHOTONS_FACTOR = 2
"""A frame has its expected light within this factor: a window may miss half of it, a transparency be misjudged by as
much; a wrong gain, unit or exposure is mostly worse."""

FLAT_TOP_PIXELS = 8
FLAT_TOP_RATIO = 5
"""A frame whose largest value is in 8 pixels or more, and 5 times as often as the next one, looks saturated:
the tail of a true image thins out towards its largest value."""


@dataclass(frozen=True, eq=False)
class PixelRules:
    """What the pixels of a frame are judged by.

    Attributes:
        level_electrons: Background and dark, to be subtracted.
        variance_electrons2: Their variance and that of the read noise.
        ignored: Pixels that the user excludes.
        saturation_electrons: A pixel this bright is full; infinite when unknown.
        flux_fractions: Share of the light of each plane.
        distances_m: For the messages.
        photons: Photo-electrons that the star is expected to have in a frame, if known.
    """

    level_electrons: Float[np.ndarray, "plane y x"]
    variance_electrons2: Float[np.ndarray, "plane y x"]
    ignored: Bool[np.ndarray, "plane y x"]
    saturation_electrons: float
    flux_fractions: Float[np.ndarray, " plane"]
    distances_m: tuple[float, ...]
    photons: float | None = None


@dataclass(frozen=True, eq=False)
class FrameReport:
    """What was found in a frame.

    Attributes:
        masked: Pixels without a usable value: ignored, NaN, infinite or saturated.
        light_electrons: Light of each plane above background and dark.
        problem: Why the frame cannot be used: a rule and the value found; None when it can.
    """

    masked: Bool[np.ndarray, "plane y x"]
    light_electrons: Float[np.ndarray, " plane"]
    not_finite_pixels: int
    saturated_pixels: int
    negative_pixels: int
    flat_top_pixels: int
    problem: str | None


def examine_frame(electrons: Float[np.ndarray, "plane y x"], rules: PixelRules) -> FrameReport:
    """Mask what cannot be used and look for what makes a frame useless.

    Args:
        electrons: As read, NaN and infinite pixels included.
    """
    not_finite = ~np.isfinite(electrons) & ~rules.ignored
    saturated = (electrons >= rules.saturation_electrons) & np.isfinite(electrons) & ~rules.ignored
    masked = rules.ignored | not_finite | saturated
    light = np.where(masked, 0.0, electrons - rules.level_electrons)
    negative = (light < -NEGATIVE_SIGMA * np.sqrt(rules.variance_electrons2)) & ~masked
    counts = {
        "not_finite_pixels": int(not_finite.sum()),
        "saturated_pixels": int(saturated.sum()),
        "negative_pixels": int(negative.sum()),
        "flat_top_pixels": _flat_top(electrons[~masked]),
    }
    light_electrons = light.sum(axis=(1, 2))
    noise_electrons = np.sqrt(np.where(masked, 0.0, rules.variance_electrons2).sum(axis=(1, 2)))
    problem = (
        _lost(counts, int((~rules.ignored).sum()))
        or _dark_or_negative(electrons[~masked], counts["negative_pixels"], light_electrons, noise_electrons)
        or _dead_plane(light_electrons, noise_electrons, rules)
        or _other_light(light_electrons, noise_electrons, rules)
    )
    return FrameReport(masked=masked, light_electrons=light_electrons, problem=problem, **counts)


def frame_warnings(reports: Sequence[FrameReport], flux_fractions: Float[np.ndarray, " plane"]) -> list[str]:
    """What the user should know about the pixels of a file: one sentence per finding, not per frame."""
    kinds = {
        "not_finite_pixels": "NaN or infinite pixels are masked",
        "saturated_pixels": "saturated pixels (SATURATE) are masked",
        "negative_pixels": "pixels are further below zero than their noise explains (5 sigma)",
        "flat_top_pixels": "pixels share the largest value of their frame: saturated? Give SATURATE",
    }
    found = []
    for name, sentence in kinds.items():
        counts = np.array([getattr(report, name) for report in reports])
        total, pixels = int(counts.sum()), sum(report.masked.size for report in reports)
        if name == "negative_pixels" and total < 1e-5 * pixels:
            continue  # that many are chance
        if total:
            where = f" in {np.count_nonzero(counts)} of {len(counts)} frames" if len(counts) > 1 else ""
            found.append(f"PRIMARY: {total} {sentence}{where}")
    light = np.sum([report.light_electrons for report in reports if report.problem is None], axis=0)
    if np.ndim(light) and light.sum() > 0:
        found += _uneven(light / light.sum(), flux_fractions)
    return found


def _flat_top(values: Float[np.ndarray, " pixel"]) -> int:
    if not values.size or values.max() <= 0:
        return 0
    at_top = values == values.max()
    below = values[~at_top]
    count = int(at_top.sum())
    if count < FLAT_TOP_PIXELS or not below.size:
        return 0
    return count if count > FLAT_TOP_RATIO * np.count_nonzero(below == below.max()) else 0


def _lost(counts: dict[str, int], pixels: int) -> str | None:
    not_finite, saturated = counts["not_finite_pixels"], counts["saturated_pixels"]
    if not_finite + saturated <= LOST_LIMIT * pixels:
        return None
    parts = [(not_finite, "NaN or infinite"), (saturated, "saturated (SATURATE)")]
    listed = " and ".join(f"{100 * count / pixels:.1f} % {name}" for count, name in parts if count)
    return f"must have at most {100 * LOST_LIMIT:g} % of its pixels without a value, got {listed}"


def _dark_or_negative(
    values: Float[np.ndarray, " pixel"], negative: int, light: np.ndarray, noise: np.ndarray
) -> str | None:
    if not values.any():
        return "must hold light, got zero everywhere"
    if negative > NEGATIVE_LIMIT * values.size:
        share = f"{100 * negative / values.size:.0f} % of the pixels below -5 sigma"
        rule = "must not be negative beyond the noise of RDNOISE, DARK and BACKGROUND"
        return f"{rule}, got {share}, down to {values.min():.3g} electrons"
    total, sigma = light.sum(), np.sqrt(np.sum(noise**2))
    if total <= FAINT_SIGMA * sigma:
        rule = "must hold light above its noise"
        return f"{rule}, got {total:.3g} electrons after background and dark, noise {sigma:.3g}"
    return None


def _dead_plane(light: np.ndarray, noise: np.ndarray, rules: PixelRules) -> str | None:
    """A plane is dead when it has 2 % of its share of the light, or 20 % and not above its noise.

    The share is what is compared, not the noise alone: every plane of a faint star is close to its noise.
    """
    promised = rules.flux_fractions * light.sum()
    dead = (light <= 0.02 * promised) | ((light <= 0.2 * promised) & (light <= FAINT_SIGMA * noise))
    if not dead.any():
        return None
    plane = int(np.argmax(dead))
    where = f"plane {plane + 1} (ZPLANE{plane + 1} = {rules.distances_m[plane]:g} m)"
    share = f"{light[plane]:.3g} of the {promised[plane]:.3g} electrons that are its share"
    return f"{where} must hold light, got {share}"


def _other_light(light: np.ndarray, noise: np.ndarray, rules: PixelRules) -> str | None:
    if rules.photons is None:
        return None
    found, doubt = float(light.sum()), FAINT_SIGMA * np.sqrt(np.sum(noise**2) + rules.photons)
    if rules.photons / PHOTONS_FACTOR - doubt <= found <= rules.photons * PHOTONS_FACTOR + doubt:
        return None
    rule = f"must hold the {rules.photons:.0f} photo-electrons of PHOTONS within a factor {PHOTONS_FACTOR}"
    return f"{rule} (up to half may miss the window), got {found:.0f}"


def _uneven(shares: np.ndarray, flux_fractions: np.ndarray) -> list[str]:
    ratio = shares / flux_fractions
    worst = int(np.argmax(np.abs(np.log(np.maximum(ratio, 1e-6)))))
    if 0.5 < ratio[worst] < 2:
        return []
    got, promised = f"{100 * shares[worst]:.1f} %", f"{100 * flux_fractions[worst]:.1f} %"
    return [f"FLUXFR{worst + 1}: plane {worst + 1} has {got} of the light, its share is {promised}"]
