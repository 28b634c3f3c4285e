"""The exposures that the cases of a study share: light on a fine and wide grid, the detector's counts, the truth."""

import json
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import light_weights
from nlcwfs.config import Config
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.interop.simulated_frames import pupil_of
from nlcwfs.simulation.exposure import ExposureSimulator, frame_key
from nlcwfs.simulation.known_sensor import geometry_of
from nlcwfs.simulation.segment_score import segment_pixels
from nlcwfs.simulation.static_aberration import lit_part
from nlcwfs.studies.study_cases import Case

Progress = Callable[[str, int, int], None]
"""Called with the case, the screens done and the screens in all."""


class Screen(NamedTuple):
    """One exposure, kept while the cases that share it run.

    Attributes:
        truth_m: The wavefront on the grid that scores it.
        counts: What the detector read, photo-electrons.
        pixels_m: Mean of the wavefront over the light of every detector pixel; NaN where there is none.
    """

    truth_m: Float[np.ndarray, "Y X"]
    counts: Float[np.ndarray, "plane y x"]
    pixels_m: Float[np.ndarray, "y x"]


class Light(NamedTuple):
    """All the screens of one kind of light.

    Attributes:
        screens: The exposures.
        grid: Grid of the truth.
        weights: Share of the light in its cells.
        pixel_weights: Share of the light on the detector's pixels.
        segments: Segment of every pixel and the light that it has of that segment alone; None for one piece.
    """

    screens: list[Screen]
    grid: Grid
    weights: Float[np.ndarray, "Y X"]
    pixel_weights: Float[np.ndarray, "y x"]
    segments: tuple[Int[np.ndarray, "y x"], Float[np.ndarray, "y x"]] | None = None

    def first(self, count: int) -> "Light":
        """The same light, fewer screens."""
        return self._replace(screens=self.screens[:count])


def make_light(case: Case, config: Config, count: int, progress: Progress) -> Light:
    """Expose the detector to `count` skies."""
    simulator = ExposureSimulator.build(config, pupil_of(config))
    cut = lit_part(np.asarray(simulator.weights))
    weights = np.asarray(simulator.weights, float)[cut]
    grid = simulator.light.padded(weights.shape)
    matched = matched_model(config, simulator) if case.light == "matched" else None
    screens = []
    for number in range(count):
        exposure = simulator.expose(frame_key(seed=config.seed, frame=number))
        truth_m, pixels_m = np.asarray(exposure.opd_m)[cut], np.asarray(exposure.truth_m)
        counts = np.asarray(exposure.frames.electrons)
        if matched is not None:
            truth_m = np.nan_to_num(pixels_m)
            photons = matched.images(jnp.asarray(truth_m), config.atmosphere.photons).photons
            key = jax.random.fold_in(frame_key(seed=config.seed, frame=number), 1)
            counts = np.asarray(simulator.detector.read(photons, key).electrons)
        screens.append(Screen(truth_m, counts - simulator.detector.background_electrons, pixels_m))
        progress(f"{case.name}: light", number + 1, count)
    if matched is not None:
        shares = light_weights(np.asarray(matched.pupil))
        return Light(screens, simulator.frame, shares, shares)
    shares = integrate_on_pixels(simulator.weights[None], factor=simulator.factor, window=simulator.window)[0]
    return Light(screens, grid, weights, np.asarray(shares, float), segment_pixels(simulator))


def matched_model(config: Config, simulator: ExposureSimulator) -> CurvatureSensor:
    """The sensor on the grid of the reconstructor: the inverse crime, to show what it flatters."""
    return geometry_of(config, simulator).model(simulator.frame, dtype="float32")


def light_kind(case: Case, config: Config) -> str:
    """Cases with the same text here share their light.

    Examples:
        >>> one, other = (Case(name=name, group="g") for name in "ab")
        >>> light_kind(one, Config()) == light_kind(other, Config()) != light_kind(one, Config(seed=1))
        True
    """
    return json.dumps([config.model_dump(mode="json", exclude={"estimation"}), case.light], sort_keys=True)
