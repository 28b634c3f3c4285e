"""The wind that is found, against drawn frozen flow whose wind is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.atmosphere.frozen_flow import FrozenFlow, WindLayer
from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.wind import found_wind

GRID = Grid((32, 32), 0.125)
LIT = np.hypot(GRID.x_m, GRID.y_m) < 2.0


def frames(layers: list[WindLayer], *, count: int = 120, seed: int = 0, interval_s: float = 0.005) -> np.ndarray:
    screens = PhaseScreens.build(Turbulence(0.15), shape=GRID.shape, pixel_m=GRID.pixel_m, period=512)
    flow = FrozenFlow.build(screens, layers, jax.random.key(seed))
    moving = eqx.filter_jit(lambda moment_s: flow.opd_m(moment_s))
    return np.stack([np.asarray(moving(jnp.float32(number * interval_s)), float) for number in range(count)])


@pytest.mark.parametrize(("speed", "direction_deg"), [(4.0, 30.0), (10.0, -100.0), (25.0, 170.0)])
@pytest.mark.parametrize("seed", range(3))
def test_speed_and_direction_are_found(speed, direction_deg, seed):
    """Within 2 %, amid noise of 40 nm on every cell of every wavefront, and beside a shape that stays."""
    opd_m = frames([WindLayer(1.0, speed, direction_deg)], seed=seed)
    rng = np.random.default_rng(seed)
    opd_m = opd_m + 40e-9 * rng.standard_normal(opd_m.shape) + 300e-9 * rng.standard_normal(opd_m.shape[1:])
    wind = found_wind(opd_m, LIT, pixel_m=GRID.pixel_m, interval_s=0.005)
    assert wind is not None
    angle = np.radians(direction_deg)
    wrong = np.hypot(wind.y_m_per_s - speed * np.sin(angle), wind.x_m_per_s - speed * np.cos(angle))
    assert wrong < 0.02 * speed + 0.05


def test_the_stronger_of_two_layers_is_found():
    wind = found_wind(
        frames([WindLayer(0.75, 8.0, 0.0), WindLayer(0.25, 20.0, 90.0)], count=200),
        LIT,
        pixel_m=GRID.pixel_m,
        interval_s=0.005,
    )
    assert wind is not None
    assert np.hypot(wind.y_m_per_s, wind.x_m_per_s - 8.0) < 0.6


@pytest.mark.parametrize("seed", range(3))
def test_wavefronts_that_have_nothing_in_common_have_no_wind(seed):
    rng = np.random.default_rng(seed)
    opd_m = np.stack(
        [frames([WindLayer(1.0, 0.0, 0.0)], count=1, seed=int(one))[0] for one in rng.integers(1 << 30, size=40)]
    )
    assert found_wind(opd_m, LIT, pixel_m=GRID.pixel_m, interval_s=0.005) is None
