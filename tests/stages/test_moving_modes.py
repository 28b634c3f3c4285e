"""Modes of air that moves on: against drawn frozen flow, plain iteration and integrals of the spectrum."""

import jax
import numpy as np
import pytest
import scipy.integrate
import scipy.special

from nlcwfs.atmosphere.frozen_flow import FrozenFlow, WindLayer
from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.estimation.moving_modes import (
    Step,
    carried,
    displaced_covariance,
    left_covariance,
    settled_covariance,
)

FINER = 3


@pytest.mark.parametrize("outer_scale_m", [np.inf, 30.0, 4.0])
def test_structure_function_is_the_integral_of_the_spectrum(outer_scale_m):
    air = Turbulence(0.15, outer_scale_m=outer_scale_m)
    apart_m = np.array([0.01, 0.3, 2.0, 9.0])
    edges = np.geomspace(1e-13, 1e4, 400_001)
    angle = 2 * np.pi * edges * apart_m[:, None]
    seen = np.where(angle < 1e-3, (angle / 2) ** 2, 1 - scipy.special.j0(angle))
    wanted = scipy.integrate.trapezoid(4 * np.pi * air.opd_spectrum(edges) * seen * edges**2, np.log(edges))
    assert air.structure_m2(apart_m) == pytest.approx(wanted, rel=1e-3)


@pytest.fixture(scope="module")
def pupil():
    grid = Grid((20, 20), 0.1)
    disc = (np.hypot(grid.x_m, grid.y_m) < 0.95).astype(float)
    return grid, modal_basis(disc, grid, diameter_m=1.9, count=60)


@pytest.mark.parametrize("outer_scale_m", [np.inf, 5.0])
def test_new_air_is_what_drawn_frozen_flow_brings(pupil, outer_scale_m):
    _, basis = pupil
    air, moved_m = Turbulence(0.15, outer_scale_m=outer_scale_m), (0.05, -0.2)
    now = displaced_covariance(basis, 0.1, air, [(0.0, 0.0)])
    step = carried(now, displaced_covariance(basis, 0.1, air, [moved_m]))
    fine = PhaseScreens.build(air, shape=(20 * FINER, 20 * FINER), pixel_m=0.1 / FINER, period=400)
    layer = WindLayer(1.0, float(np.hypot(*moved_m)), float(np.degrees(np.arctan2(*moved_m))))

    def seen(key) -> np.ndarray:
        flow = FrozenFlow.build(fine, [layer], key)
        both = np.stack([np.asarray(flow.opd_m(time_s), float) for time_s in (0.0, 1.0)])
        cells = both.reshape(2, 20, FINER, 20, FINER).mean((2, 4))
        return np.stack([np.asarray(basis.project(one), float) for one in cells])

    drawn = np.stack([seen(jax.random.key(number)) for number in range(150)])
    error = drawn[:, 1] - drawn[:, 0] @ step.again.T
    assert np.sum(error**2, axis=1).mean() == pytest.approx(np.trace(step.new), rel=0.06)
    variance, shape = np.linalg.eigh(step.new)
    surprise = np.mean((error @ shape) ** 2, axis=0)[30:] / variance[30:]  # below, the pixels of the screens rule
    assert 0.6 < surprise.min() < 0.95 < surprise.mean() < 1.15 < surprise.max() < 1.6
    plain = np.sum((drawn[:, 1] - drawn[:, 0]) ** 2, axis=1).mean()
    assert np.trace(step.new) < plain / 3  # the other direction of the wind would not pass
    backward = drawn[:, 0] - drawn[:, 1] @ step.again.T
    assert np.sum(backward**2) > 3 * np.sum(error**2)


def test_doubling_settles_where_plain_iteration_does(pupil):
    _, basis = pupil
    air = Turbulence(0.15)
    now = displaced_covariance(basis, 0.1, air, [(0.0, 0.0)])
    step = carried(now, displaced_covariance(basis, 0.1, air, [(0.02, 0.05)]))
    drawn = np.random.default_rng(1).standard_normal((60, 80))
    information = drawn @ drawn.T / np.mean(np.diag(now)) / 40
    p = now
    for _ in range(2000):
        p = step.again @ np.linalg.inv(np.linalg.inv(p) + information) @ step.again.T + step.new
    assert settled_covariance(step, information) == pytest.approx(p, rel=1e-6, abs=1e-8 * np.trace(p))
    wanted = np.linalg.inv(np.linalg.inv(p) + information)
    assert left_covariance(p, information) == pytest.approx(wanted, rel=1e-6, abs=1e-8 * np.trace(p))


def test_nothing_seen_leaves_the_whole_air(pupil):
    _, basis = pupil
    air = Turbulence(0.15, outer_scale_m=20.0)
    now = displaced_covariance(basis, 0.1, air, [(0.0, 0.0)])
    step = carried(now, displaced_covariance(basis, 0.1, air, [(0.0, 1.0)]))
    p = settled_covariance(Step(step.again, step.new), np.zeros_like(now))
    assert p == pytest.approx(now, abs=1e-4 * np.trace(now))
