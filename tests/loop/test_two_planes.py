"""What an open loop believes with few planes; search and second look are stood in for."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import pytest

from nlcwfs.detector.read import Frames
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.simulation.closed_loop.measurement import FollowedCurvature
from nlcwfs.simulation.closed_loop.sight import Sight
from nlcwfs.simulation.exposure import Exposure


@pytest.mark.parametrize(("planes", "believed"), [(2, 0), (3, 1), (4, 1)])
def test_light_that_is_explained_proves_nothing_with_two_planes(planes, believed):
    counts, flat = jnp.ones((planes, 4, 4)), jnp.zeros((4, 4))
    estimate: Any = SimpleNamespace(outcome_code=int(Outcome.NOT_EXPLAINED), ffts=100, unexplained=0.1)
    loop: Any = SimpleNamespace(
        _looked=lambda *_: (estimate, None, jnp.zeros(3)),
        _without_islands=lambda *_: (0, None, jnp.zeros(3), 10),
        _sight=lambda estimate, part, outcome, ffts, closed: Sight(part, outcome, 0.0, ffts, closed),
    )
    frames = Frames(counts, jnp.zeros(counts.shape, bool))
    exposure = Exposure(flat, counts, frames, flat, jnp.zeros(planes))
    sight, after = FollowedCurvature.measure(loop, exposure, jnp.ones(counts.shape, bool), flat, None)
    assert (after.sure, sight.outcome.succeeded) == (believed, bool(believed))
