"""What pixels and windows a sensor needs, and which settings are refused."""

import numpy as np
import pytest

from nlcwfs.beam.sampling import check_sampling, sampling_needed
from nlcwfs.beam.sampling_cost import SensedLight, light_outside, pixel_error
from nlcwfs.errors import SamplingError

LIGHT = SensedLight(diameter_m=8.0, wavelength_m=0.85e-6)


def test_the_papers_example_comes_out_with_its_factor_mended():
    # Guyon 2010, sec. 2.5: D 8 m, 0.8 um, alpha = 10 lambda / D: z0 = 4000 km, where N is 8 D alpha / lambda.
    light = SensedLight(diameter_m=8.0, wavelength_m=0.8e-6, cycles_per_aperture=10.0)
    alpha_rad = 10 * 0.8e-6 / 8.0
    need = sampling_needed(light, [4e6])
    assert light.half_angle_rad == pytest.approx(alpha_rad, rel=1e-12)
    assert need.window_m == pytest.approx(16.0)  # twice the pupil: the definition of z0
    assert need.window_pixels == 80  # 8 D alpha / lambda; the paper prints 4
    far = sampling_needed(light, [4e9])
    assert far.window_m / far.pixel_m == pytest.approx(4 * 8.0 * alpha_rad / 0.8e-6, rel=2e-3)  # z >> z0


@pytest.mark.parametrize("distance_m", [3e6, -3.5e6, 7e6])
def test_beyond_z0_pixels_follow_the_law_of_the_paper(distance_m):
    plane = sampling_needed(LIGHT, [distance_m]).planes[0]
    z, alpha_rad = abs(distance_m), 16 * 0.85e-6 / 8
    assert plane.pixel_m == pytest.approx(0.85e-6 * z / 16)
    assert plane.window_m == pytest.approx(8 + 2 * z * alpha_rad)
    assert plane.window_pixels == np.ceil(16 * (8 + 2 * z * alpha_rad) / (0.85e-6 * z))


def test_nearer_than_z0_pixels_stop_shrinking():
    z0_m = 8 / (2 * 16 * 0.85e-6 / 8)
    at_z0, near = (sampling_needed(LIGHT, [z]).pixel_m for z in (z0_m, 300e3))
    assert near == pytest.approx(at_z0, rel=1e-12)
    assert near == pytest.approx(0.125)  # lambda / (4 alpha) = D / (4 x 16)


def test_the_seeing_widens_the_window_when_it_exceeds_the_control_radius():
    rough = SensedLight(diameter_m=8.0, wavelength_m=0.85e-6, cycles_per_aperture=4.0, fried_m=0.318)
    assert rough.half_angle_rad == pytest.approx(0.976 * 0.85e-6 / 0.318 / 2)
    fine = SensedLight(diameter_m=8.0, wavelength_m=0.85e-6, cycles_per_aperture=16.0, fried_m=0.318)
    assert fine.half_angle_rad == pytest.approx(16 * 0.85e-6 / 8)


def test_equal_pixels_serve_the_most_demanding_plane():
    need = sampling_needed(LIGHT, [-3.5e6, 2.5e6])
    assert need.pixel_m == pytest.approx(0.85e-6 * 2.5e6 / 16)
    assert need.pixels_across_pupil == 61
    assert need.window_m == pytest.approx(8 + 2 * 3.5e6 * 16 * 0.85e-6 / 8)
    assert need.window_pixels == 150


def test_a_window_without_travel_loses_nothing_and_a_halved_one_its_area():
    assert light_outside(LIGHT, distance_m=0.0, window_m=8.5) == pytest.approx(0, abs=1e-9)
    inner = 4.0 * 4.0 / (np.pi * 16)  # a square of half the diameter lies wholly in the circle
    assert light_outside(LIGHT, distance_m=0.0, window_m=4.0) == pytest.approx(1 - inner, rel=1e-3)


def test_fine_pixels_cost_nothing_and_the_cost_grows_with_the_square():
    rough = SensedLight(diameter_m=8.0, wavelength_m=0.85e-6, fried_m=0.5)
    errors = [pixel_error(rough, distance_m=3.5e6, pixel_m=p) for p in (0.01, 0.02, 0.04)]
    assert errors[0] < 2e-3
    # 1 - sinc ~ p^2
    assert errors[1] / errors[0] == pytest.approx(4, rel=0.02)
    assert errors[2] / errors[1] == pytest.approx(4, rel=0.04)


def test_a_sufficient_setting_passes_without_a_word():
    assert check_sampling(LIGHT, [-3.5e6, 3.5e6], pixel_m=0.12, window_m=26.0) == []


def test_a_narrow_window_is_told_how_much_light_it_loses():
    rough = SensedLight(diameter_m=8.0, wavelength_m=0.65e-6, fried_m=0.5)
    (warning,) = check_sampling(rough, [3.5e6], pixel_m=0.1, window_m=11.4)
    assert warning.error == pytest.approx(light_outside(rough, distance_m=3.5e6, window_m=11.4))
    assert str(warning).startswith("At 3500 km a window of 11.4 m misses 1")
    assert "D + 2 z alpha is 17.1 m" in str(warning)


def test_a_coarse_pixel_is_told_how_much_contrast_it_leaves():
    (warning,) = check_sampling(LIGHT, [3.5e6], pixel_m=0.3, window_m=40.0)
    speckle_m = 0.85e-6 * 3.5e6 / 8
    assert warning.error == pytest.approx(1 - np.sinc(0.3 / speckle_m))
    assert f"leave {np.sinc(0.3 / speckle_m):.0%}".replace("%", " %") in str(warning)


def test_a_periodic_grid_is_told_the_error_of_its_intensity():
    rough = SensedLight(diameter_m=8.0, wavelength_m=0.85e-6, cycles_per_aperture=5.0, rms_rad=3.0)
    warnings = check_sampling(rough, [3.5e6], pixel_m=8 / 45, window_m=64 * 8 / 45, periodic=True)
    assert "light re-enters its window" in str(warnings[-1])
    assert 0.24 < warnings[-1].error < 0.6  # simulated: 24 to 53 %


@pytest.mark.parametrize(
    ("choice", "says"),
    [
        (
            {"pixel_m": 2.1, "window_m": 40.0},
            "sampling.pixel_m: must be positive and put at least 4 .* got 2.1",
        ),
        ({"pixel_m": 0.0, "window_m": 40.0}, "sampling.pixel_m: must be positive .* got 0.0"),
        (
            {"pixel_m": 0.1, "window_m": 7.9},
            "sampling.window_m: must hold at least the pupil of 8 m, got 7.9",
        ),
        ({"pixel_m": 0.1, "window_m": float("nan")}, "sampling.window_m: .* got nan"),
        (
            {"pixel_m": 0.8, "window_m": 40.0},
            "sampling.pixel_m: must be at most two speckles, 0.744 m, got 0.8",
        ),
    ],
)
def test_impossible_settings_are_refused_in_one_line(choice, says):
    with pytest.raises(SamplingError, match=says):
        check_sampling(LIGHT, [3.5e6], **choice)


@pytest.mark.parametrize("distances_m", [[], [np.inf]])
def test_planes_must_be_somewhere(distances_m):
    with pytest.raises(SamplingError, match=r"sampling\.distances_m: must be at least one finite distance"):
        sampling_needed(LIGHT, distances_m)


@pytest.mark.parametrize("wrong", [{"diameter_m": 0.0}, {"wavelength_m": -1.0}, {"fried_m": 0.0}, {"rms_rad": -0.1}])
def test_impossible_light_is_refused(wrong):
    (key,) = wrong
    with pytest.raises(SamplingError, match=rf"light\.{key}: must be"):
        SensedLight(**{"diameter_m": 8.0, "wavelength_m": 1e-6, **wrong})
