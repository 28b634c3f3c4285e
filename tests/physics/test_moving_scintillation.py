"""Air at altitude that moves: NumPy's travel of each frozen layer, moved as the wind says; energy; who refuses it."""

import math

import jax
import numpy as np
import pytest

from nlcwfs.atmosphere.frozen_flow import FINEST, FrozenFlow, WindLayer
from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.atmosphere.scintillation import scintillation_index
from nlcwfs.beam.moving_air_at_pupil import at_pupil
from nlcwfs.config import load_config
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.sequence import SequenceSimulator

AIR = Turbulence(0.168, 0.5e-6)
COLOUR_M, PIXEL_M, PERIOD, SHAPE = 0.85e-6, 0.05, 384, (36, 29)
HEIGHTS_M, SHARES = (0.0, 4e3, 12e3), (0.5, 0.2, 0.3)
WINDS = ((10.0, 0.0), (5.0, 90.0), (20.0, 180.0))
LIGHT = {"wavelength_m": COLOUR_M, "pixel_m": PIXEL_M}


def flow(seed: int = 1) -> FrozenFlow:
    screens = PhaseScreens.build(AIR, shape=SHAPE, pixel_m=PIXEL_M, period=PERIOD, dtype="float64")
    layers = [WindLayer(share, *wind) for share, wind in zip(SHARES, WINDS, strict=True)]
    return FrozenFlow.build(screens, layers, jax.random.key(seed))


def travelled(fine_m: np.ndarray, height_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Wavefront and log-amplitude that a layer leaves (Roddier 1981, sec. 5): cosine and sine of pi lambda h f^2."""
    f = np.fft.fftfreq(PERIOD, PIXEL_M)
    angle = np.pi * COLOUR_M * height_m * (f[:, None] ** 2 + f[None, :] ** 2)
    waves = np.fft.fft2(np.asarray(fine_m, float))
    opd_m, chi_m = (np.fft.ifft2(one(angle) * waves).real for one in (np.cos, np.sin))
    return opd_m, 2 * np.pi / COLOUR_M * chi_m


def carried(pattern: np.ndarray, wind: tuple[float, float], time_s: float) -> np.ndarray:
    """A periodic pattern moved by whole cells."""
    turn, cells = math.radians(wind[1]), wind[0] * time_s / PIXEL_M
    return np.roll(pattern, (round(cells * math.sin(turn)), round(cells * math.cos(turn))), (0, 1))


@pytest.mark.parametrize("time_s", [0.0, 0.05])
def test_wavefront_and_amplitude_move_as_their_layers_do(time_s):
    """At 0.05 s each layer has moved by whole cells: 10 to +x, 5 to +y, 20 to -x."""
    air = flow()
    moved, twinkling = at_pupil(air, heights_m=HEIGHTS_M, **LIGHT)
    opd_m, flat_m, chi = np.zeros((3, PERIOD, PERIOD))
    for layer, height_m, wind in zip(air.layers, HEIGHTS_M, WINDS, strict=True):
        own_m, own_chi = (carried(part, wind, time_s) for part in travelled(layer.fine_m, height_m))
        opd_m, chi = opd_m + own_m, chi + own_chi
        flat_m = flat_m + carried(np.asarray(layer.fine_m, float), wind, time_s)
    cut = slice(SHAPE[0]), slice(SHAPE[1])
    amplitude = np.asarray(twinkling.amplitude(time_s))
    np.testing.assert_allclose(np.log(amplitude), chi[cut] - float(twinkling.variance), atol=1e-5)
    # What a layer loses by travel is all that changes in the wavefront: the long waves stay.
    less_m = np.asarray(air.opd_m(time_s) - moved.opd_m(time_s), float)
    np.testing.assert_allclose(less_m, (flat_m - opd_m)[cut], atol=1e-11)


def test_the_amplitude_has_the_variance_of_its_waves_and_keeps_the_light():
    """Sum over the square of frequencies that the air holds; the mean of the light of much air is 1."""
    found = [at_pupil(flow(seed), heights_m=HEIGHTS_M, **LIGHT)[1] for seed in range(4)]
    f = np.fft.fftfreq(PERIOD, PIXEL_M)
    held = np.abs(f) <= FINEST / 2 / PIXEL_M
    f2 = f[:, None] ** 2 + f[None, :] ** 2
    f2[0, 0] = 1
    spectrum = 0.0229 * AIR.fried_at(COLOUR_M) ** (-5 / 3) * f2 ** (-11 / 6) / (PERIOD * PIXEL_M) ** 2
    spectrum = np.where(held[:, None] & held[None, :], spectrum, 0)
    spectrum[0, 0] = 0
    waves = zip(HEIGHTS_M, SHARES, strict=True)
    variance = sum(share * np.sum(spectrum * np.sin(np.pi * COLOUR_M * one * f2) ** 2) for one, share in waves)
    assert np.mean([float(one.variance) for one in found]) == pytest.approx(variance, rel=0.02)  # 4 x ~10^4 speckles
    light = [np.mean(np.square(one.amplitude(0.07 * moment))) for one in found for moment in range(12)]
    assert np.mean(light) == pytest.approx(1, abs=4 * np.std(light) / math.sqrt(len(light)))
    # A disc of the area of 1.8 m x 1.45 m, in closed form: 0.7 %; 48 exposures tell it to 10 %, 3 sigma.
    index = scintillation_index(AIR, HEIGHTS_M, SHARES, wavelength_m=COLOUR_M, diameter_m=1.82)
    assert np.std(light) == pytest.approx(math.sqrt(index), rel=0.3)


SMALL = [
    "beam.diameter_m=2",
    "curvature_sensor.distances_km=[-219, 219]",
    "detector.pixels_across_pupil=20",
    "detector.window_pixels=32",
    "atmosphere.seeing_arcsec=0.6",
    "atmosphere.photons=1e6",
    "atmosphere.layer_fractions=[0.5, 0.5]",
    "atmosphere.wind_speeds_m_per_s=[10, 10]",
    "atmosphere.wind_directions_deg=[0, 0]",
    "simulation.rate_hz=500",
    "simulation.frames=20",
]
HIGH = "atmosphere.layer_heights_km=[0, 10]"


def test_the_light_of_a_sequence_is_that_of_the_amplitude_over_the_pupil():
    sequence, even = (SequenceSimulator.build(load_config(None, [*SMALL, *more])) for more in ([HIGH], []))
    assert even.log_variance is None
    photons = []
    for frame in range(0, 20, 4):
        exposure = sequence.expose(frame)
        moments = sequence.moments_s(frame)
        squares = [np.asarray(sequence.factor(moment)[0]) ** 2 for moment in moments]
        told = 1e6 * float(np.sum(np.asarray(sequence.still.weights) * np.mean(squares, axis=0)))
        photons.append(float(np.sum(exposure.photons.sum((1, 2)) / (1 - exposure.lost))))
        assert photons[-1] == pytest.approx(told, rel=1e-3)
    assert np.std(photons) > 1e3
    # The wavefront is that of the same air, but for fine waves: 0.6" at 10 km on cells of 5 cm.
    both_m = [np.asarray(one.expose(3).opd_m, float) for one in (sequence, even)]
    assert 0 < np.std(both_m[0] - both_m[1]) < 0.1 * np.std(both_m[1])


def test_many_colours_and_strong_scintillation_are_refused_in_a_line():
    flat = ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.2"]
    with pytest.raises(SettingsError, match=r"layer_heights_km: must be 0 with light of many colours in sequences"):
        SequenceSimulator.build(load_config(None, [*SMALL, HIGH, *flat]))
    high = load_config(None, [*SMALL, HIGH])
    strong = high.atmosphere.model_copy(update={"seeing_arcsec": 3.0})
    with pytest.raises(SettingsError, match=r"layer_heights_km: must leave the scintillation weak"):
        SequenceSimulator.build(high.model_copy(update={"atmosphere": strong}))


def test_the_same_moving_air_is_drawn_with_and_without_heights():
    air = flow()
    flat, twinkling = at_pupil(air, heights_m=(0.0, 0.0, 0.0), **LIGHT)
    np.testing.assert_allclose(flat.opd_m(0.013), air.opd_m(0.013), atol=1e-12)
    assert float(twinkling.variance) < 1e-20
