"""The rms of a wavefront by groups of modes: every part in its group, and all parts together the whole."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil import circular_pupil
from nlcwfs.errors import SettingsError
from nlcwfs.science.rms_groups import rms_groups

GRID = Grid((35, 39), 0.25)
PUPIL = circular_pupil(GRID, diameter_m=8.0, obstruction_ratio=0.3)
SEEN = np.where(PUPIL < 0.1, 0, PUPIL) ** 2
WEIGHTS = SEEN / SEEN.sum()
KINDS = ("karhunen-loeve", "disc-harmonics")
BASES = {kind: modal_basis(PUPIL, GRID, diameter_m=8.0, count=400, kind=kind) for kind in KINDS}
NAMES = ("tip_tilt_m", "low_m", "middle_m", "high_m", "beyond_m")


def rms(opd_m):
    mean_m = np.sum(WEIGHTS * opd_m)
    return np.sqrt(np.sum(WEIGHTS * (opd_m - mean_m) ** 2))


@settings(deadline=None, max_examples=30)
@given(
    seed=st.integers(0, 2**31 - 1),
    kind=st.sampled_from(KINDS),
    piston_m=st.floats(-1e-6, 1e-6),
    slope=st.floats(-1e-6, 1e-6),
    edges=st.tuples(st.floats(0, 14), st.floats(0, 14)).map(sorted).map(tuple),
)
def test_the_squares_of_the_groups_add_up_to_the_square_of_the_whole(seed, kind, piston_m, slope, edges):
    opd_m = 1e-7 * np.random.default_rng(seed).normal(size=GRID.shape) + piston_m + slope * (GRID.x_m - 2 * GRID.y_m)
    groups = rms_groups(opd_m, BASES[kind], edges_cpa=edges)
    whole = np.sqrt(sum(float(getattr(groups, name)) ** 2 for name in NAMES))
    assert whole == pytest.approx(rms(opd_m), rel=1e-9)  # rounding of 400 projections
    assert float(groups.total_m) == pytest.approx(whole, rel=1e-12)


@settings(deadline=None, max_examples=20)
@given(place=st.integers(2, 399), kind=st.sampled_from(KINDS))
def test_a_mode_falls_into_the_group_of_its_frequency(place, kind):
    basis = BASES[kind]
    cycles = basis.cycles_per_aperture[place]
    groups = rms_groups(5e-8 * basis.modes[place], basis)
    own = "low_m" if cycles < 4 else "middle_m" if cycles < 12 else "high_m"
    found = {name: float(getattr(groups, name)) for name in NAMES}
    # Karhunen-Loeve modes, orthogonal to the first two, hold a few per cent of ramps.
    assert found.pop(own) == pytest.approx(5e-8, rel=0.02)
    assert max(found.values()) < 0.15 * 5e-8


@pytest.mark.parametrize("kind", KINDS)
def test_all_groups_are_there(kind):
    cycles = BASES[kind].cycles_per_aperture
    assert np.any(cycles < 4)
    assert np.any((cycles >= 4) & (cycles < 12))
    assert np.any(cycles >= 12)


@pytest.mark.parametrize("kind", KINDS)
def test_ramps_are_tip_tilt_and_nothing_else(kind):
    ramp_m = 3e-8 * (GRID.x_m - 0.4 * GRID.y_m) + 5e-7
    groups = rms_groups(ramp_m, BASES[kind])
    assert float(groups.tip_tilt_m) == pytest.approx(rms(ramp_m), rel=1e-12)
    for name in NAMES[1:]:
        assert float(getattr(groups, name)) < 1e-12 * rms(ramp_m) + 1e-20


def test_what_is_finer_than_the_basis_lies_beyond_it():
    fine_m = 1e-7 * np.cos(2 * np.pi * 15 / 8 * GRID.x_m) * np.ones(GRID.shape)  # 15 cycles; the basis ends at 13
    groups = rms_groups(fine_m, BASES["karhunen-loeve"])
    assert float(groups.beyond_m) > 0.9 * rms(fine_m)  # the edges of the pupil smear frequencies


def test_the_outside_is_not_looked_at_and_jit_changes_nothing():
    basis = BASES["karhunen-loeve"]
    opd_m = 1e-7 * np.random.default_rng(3).normal(size=GRID.shape)
    plain = rms_groups(opd_m, basis)
    marked = jax.jit(lambda wavefront_m: rms_groups(wavefront_m, basis))(np.where(WEIGHTS > 0, opd_m, np.nan))
    for name in NAMES:
        assert float(getattr(marked, name)) == pytest.approx(float(getattr(plain, name)), rel=1e-12)


def test_single_precision_knows_a_nanometre():
    opd_m = (1e-7 * np.random.default_rng(4).normal(size=GRID.shape) + 1e-6 * GRID.x_m).astype(np.float32)
    single = rms_groups(opd_m, BASES["karhunen-loeve"])
    double = rms_groups(opd_m.astype(np.float64), BASES["karhunen-loeve"])
    assert single.low_m.dtype == np.float32
    for name in NAMES:
        assert float(getattr(single, name)) == pytest.approx(float(getattr(double, name)), abs=5e-12)


def test_edges_must_be_in_order():
    with pytest.raises(SettingsError, match=r"edges_cpa: must be two frequencies, .* first, got \(9.0, 2.0\)"):
        rms_groups(np.zeros(GRID.shape), BASES["karhunen-loeve"], edges_cpa=(9.0, 2.0))
