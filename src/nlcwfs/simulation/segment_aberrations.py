"""How the segments of a simulated pupil stand: pistons that are given or drawn, and tilts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.settings import SegmentsSettings
from nlcwfs.estimation.segment_steps import SegmentSteps

OWN_KEY = 2010
"""Folded into the key of a frame, so that air and noise are drawn as they are without segments."""


class SegmentAberrations(eqx.Module):
    """Draws the piston, tip and tilt of every segment.

    Attributes:
        steps: The segments, in metres.
        pistons_m: Given for each.
        range_m: Others are drawn evenly from minus to plus this.
        tilt_rms_m: Of a tilt along one axis, over a segment.

    Examples:
        >>> from nlcwfs.simulation.telescope import telescope
        >>> from nlcwfs.config import load_config
        >>> shape = telescope(load_config(None, ["beam.segments.layout=sparse"]))
        >>> still = SegmentsSettings(layout="sparse", pistons_nm=(100.0, 0.0, 0.0, 0.0))
        >>> stand = SegmentAberrations.build(still, shape, Grid((16, 16), 0.5), np.ones((16, 16)), dtype="float64")
        >>> opd_m = stand.draw(jax.random.key(0))
        >>> [round(float(one) * 1e9, 6) for one in opd_m[8, jnp.array([2, 13])]]
        [0.0, 100.0]
    """

    steps: SegmentSteps
    pistons_m: Float[Array, " segment"]
    range_m: float = eqx.field(static=True)
    tilt_rms_m: float = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        settings: SegmentsSettings,
        shape: PupilShape,
        grid: Grid,
        pupil: Float[np.ndarray, "y x"],
        *,
        dtype: str,
    ) -> "SegmentAberrations | None":
        """Prepare the segments of a pupil; None where nothing of them is asked for.

        Args:
            settings: Pistons and tilts.
            shape: The pupil.
            grid: Of the light.
            pupil: Its amplitude there.
            dtype: Precision.
        """
        labels = shape.labels(grid)
        if labels is None or not (settings.pistons_nm or settings.piston_range_nm or settings.tilt_rms_nm):
            return None
        steps = SegmentSteps.build(grid, pupil**2, labels, piston_rms_rad=1.0, tilt_rms_rad=1.0, dtype=dtype)
        given = np.array(settings.pistons_nm) if settings.pistons_nm else np.zeros(steps.count)
        return cls(
            steps, jnp.asarray(given * 1e-9, dtype), settings.piston_range_nm * 1e-9, settings.tilt_rms_nm * 1e-9
        )

    def draw(self, key: PRNGKeyArray) -> Float[Array, "Y X"]:
        """The wavefront that the segments of one frame add.

        Args:
            key: Random key of the frame.
        """
        for_pistons, for_tilts = jax.random.split(jax.random.fold_in(key, OWN_KEY))
        count, dtype = self.steps.count, self.pistons_m.dtype
        pistons_m = self.pistons_m + self.range_m * jax.random.uniform(for_pistons, (count,), dtype, -1, 1)
        tilts_m = self.tilt_rms_m * jax.random.normal(for_tilts, (2 * count,), dtype)
        return self.steps.phase_rad(jnp.concatenate([pistons_m, tilts_m]))
