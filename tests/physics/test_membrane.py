"""The vibrating membrane: the mean over its motion, against closed forms and a direct sum; what the dead time takes."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.config import load_config
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.curvature_sensor.membrane import (
    ERROR_ALLOWED,
    MOST_IN_A_MODEL,
    membrane_moments,
    moments_needed,
    moments_of_model,
    ripple_error,
)
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.map_settings import MapSettings
from nlcwfs.simulation.colours import colours_of
from nlcwfs.simulation.exposure import ExposureSimulator

SMALL = ["detector.pixels_across_pupil=12", "detector.window_pixels=18", "beam.diameter_m=2", "mirror.cutoff_cpa=4"]
PLANES = ["curvature_sensor.distances_km=[-150, 150]"]
AIR = Turbulence.from_seeing(seeing_arcsec=0.6)


@pytest.mark.parametrize("turns_rad", [0.5, 4.0, 20.0])
def test_a_ripple_keeps_what_struve_s_function_leaves(turns_rad):
    """The mean of sin(x sin t) over half a period is Struve's function of order 0, that of the cosine Bessel's."""
    count = moments_needed(distance_m=turns_rad / np.pi, wavelength_m=1.0, finest_per_m=1.0)
    sine = membrane_moments("sine", count=count)
    assert sine.shares.sum() == pytest.approx(1, abs=1e-12)
    seen = sine.shares @ np.sin(turns_rad * sine.scales)
    assert seen == pytest.approx(scipy.special.struve(0, turns_rad * np.pi / 2), abs=1e-6)
    even = sine.shares @ np.cos(turns_rad * sine.scales)
    assert even == pytest.approx(scipy.special.j0(turns_rad * np.pi / 2), abs=1e-6)


def test_the_images_are_those_of_a_weak_ripple_in_motion():
    """A periodic ripple of 1 nm on a pupil without a rim: contrast 2 a times Struve's function, to a^2."""
    grid, colour_m, distance_m = Grid((24, 32), 0.1), 0.85e-6, 1.5e5
    frequency_per_m = 3 / 3.2
    ripple_m = 1e-9 * np.sin(2 * np.pi * frequency_per_m * grid.x_m) * np.ones((24, 1))
    sine = membrane_moments("sine", count=20)
    sensor = CurvatureSensor.build(
        np.ones((24, 32)),
        grid,
        distances_m=np.outer(sine.scales, [distance_m, -distance_m]),
        spectrum=Spectrum((colour_m,) * 20, tuple(sine.shares.tolist())),
        dtype="float64",
    )
    light = np.asarray(sensor.images(jnp.asarray(ripple_m), 2.0 * grid.x_m.size * 24).photons)
    turns = np.pi * colour_m * distance_m * frequency_per_m**2
    contrast = 2 * (2 * np.pi / colour_m) * scipy.special.struve(0, turns * np.pi / 2)
    second = (2 * np.pi / colour_m * 1e-9) ** 2
    np.testing.assert_allclose(light[0] - 1, contrast * ripple_m, atol=second)
    np.testing.assert_allclose(light[1] - 1, -contrast * ripple_m, atol=second)


def test_dead_time_takes_light_and_the_near_planes():
    still = load_config(None, [*SMALL, *PLANES])
    late = load_config(
        None, [*SMALL, *PLANES, "curvature_sensor.membrane=sine", "curvature_sensor.membrane_dead_share=0.5"]
    )
    photons = [ExposureSimulator.build(one).photons for one in (still, late)]
    assert photons[1] == pytest.approx(0.5 * photons[0])
    nearest = np.abs(colours_of(late, AIR).distances_m).min()
    assert nearest > 150e3 * np.pi / 2 * np.sin(np.pi / 4)


def test_a_square_motion_rests_at_the_planes():
    moved = colours_of(load_config(None, [*SMALL, *PLANES, "curvature_sensor.membrane=square"]), AIR)
    assert moved.distances_m.tolist() == [[-150e3, 150e3]]


def test_every_colour_moves():
    band = ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.2", "beam.spectrum.wavelengths=3"]
    still = colours_of(load_config(None, [*SMALL, *PLANES, *band, "curvature_sensor.lenses=ideal"]), AIR)
    moved = colours_of(
        load_config(None, [*SMALL, *PLANES, *band, "curvature_sensor.lenses=ideal", "curvature_sensor.membrane=sine"]),
        AIR,
    )
    count = len(moved.spectrum.shares) // 3
    assert moved.spectrum.wavelengths_m[::count] == still.spectrum.wavelengths_m
    shares = np.array(moved.spectrum.shares).reshape(3, count)
    np.testing.assert_allclose(shares.sum(1), still.spectrum.shares, rtol=1e-12)
    mean_m = np.einsum("cm,cmp->cp", shares / shares.sum(1)[:, None], moved.distances_m.reshape(3, count, 2))
    np.testing.assert_allclose(mean_m, still.distances_m, rtol=1e-9)


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (
            ["curvature_sensor.membrane=sine", "curvature_sensor.distances_km=[-150, 200]"],
            "distances_km: must be pairs with a membrane",
        ),
        (["curvature_sensor.membrane_dead_share=0.2"], "membrane_dead_share: must be 0 without a membrane"),
        (["curvature_sensor.membrane=sine", "curvature_sensor.membrane_dead_share=1"], "must be"),
    ],
)
def test_what_no_membrane_does_is_refused(asked, told):
    with pytest.raises(SettingsError, match=told):
        load_config(None, asked)


@pytest.mark.parametrize("distance_m", [0.5e6, 3.5e6])
def test_the_moments_of_a_model_miss_what_struve_s_function_says(distance_m):
    """Gauss and Legendre's sum by hand over Kolmogorov's ripples, on another net of frequencies (2 %)."""
    cycles = np.geomspace(1, 32, 5000)
    turns_rad = np.pi * 0.85e-6 * distance_m * (cycles / 8) ** 2
    true = scipy.special.struve(0, np.pi / 2 * turns_rad)
    light = {"distance_m": distance_m, "wavelength_m": 0.85e-6, "diameter_m": 8.0}
    errors = {}
    for count in range(1, 17):
        nodes, weights = scipy.special.roots_legendre(count)
        scales = np.pi / 2 * np.sin(np.pi / 4 * (nodes + 1))
        seen = np.sin(np.outer(turns_rad, scales)) @ weights / 2
        power = cycles ** (-11 / 3) * cycles * cycles  # of a wave, over a ring of the plane, a step of the logarithm
        errors[count] = np.sqrt(np.sum(power * (seen - true) ** 2) / np.sum(power * true**2))
        assert ripple_error(count, **light) == pytest.approx(errors[count], rel=0.02, abs=1e-4)
    needed = moments_of_model("sine", **light)
    assert errors[needed] <= ERROR_ALLOWED < errors[needed - 1]
    assert [moments_of_model(still, **light) for still in ("none", "square")] == [1, 1]


def test_dead_time_leaves_fewer_moments_to_follow():
    light = {"distance_m": 3.5e6, "wavelength_m": 0.85e-6, "diameter_m": 8.0}
    assert moments_of_model("sine", **light, dead_share=0.6) < moments_of_model("sine", **light)


def test_the_setting_holds_as_many_moments_as_the_rule_may_ask_for():
    assert MapSettings(membrane_moments=MOST_IN_A_MODEL).membrane_moments == MOST_IN_A_MODEL
    with pytest.raises(SettingsError, match=r"^estimation\.map\.membrane_moments: must be a whole number from 1 to 64"):
        load_config(None, [f"estimation.map.membrane_moments={MOST_IN_A_MODEL + 1}"])
