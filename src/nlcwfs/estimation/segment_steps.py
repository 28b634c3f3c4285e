"""Piston, tip and tilt of each segment of a pupil, as unknowns of their own: no turbulence expects a step."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import scipy.spatial
from jaxtyping import Array, Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.prior_settings import PriorSettings
from nlcwfs.estimation.resolution_level import LIT, Level
from nlcwfs.estimation.sensor_geometry import SensorGeometry

ALL_PAIRS_UP_TO = 12
"""Segments of a pupil of which the light of every two is looked at: their number goes with the square."""


class SegmentSteps(eqx.Module):
    """Phases that are straight on each segment: all pistons, then all tilts along y, then all along x.

    Every cell follows the segment of its label, lit or dark: a rim cell has the whole piston of its segment.

    Attributes:
        labels: Segment of each cell, row by row.
        y: Ramp along y over each segment, about the middle of its light, of unit rms on a disc as wide.
        x: The same along x.
        light: Share of a full cell's light, 0 where too dark; row by row.
        nearest: The lit cell of the same segment that is nearest to each cell.
        inverse: From the sums of a phase with 1, y and x over the light of each segment to its straight part.
        rms_rad: Expected piston and expected tilt along one axis.
        count: Number of segments.
        pairs: Segments whose light meets, see `neighbours`.

    Examples:
        >>> labels = np.repeat([[0, 0, 0, 0, 1, 1, 1, 1]], 4, axis=0)
        >>> grid, light = Grid((4, 8), 1.0), np.ones((4, 8))
        >>> steps = SegmentSteps.build(grid, light, labels, piston_rms_rad=2.0, tilt_rms_rad=1.0)
        >>> phase = jnp.asarray(np.where(labels == 1, 3.0, 0.0))
        >>> found = steps.fitted(phase)
        >>> found.round(6).tolist(), bool(jnp.allclose(steps.phase_rad(found), phase))
        ([0.0, 1.5, 0.0, 0.0, 0.0, 0.0], True)
    """

    labels: Int[Array, " cell"]
    y: Float[Array, " cell"]
    x: Float[Array, " cell"]
    light: Float[Array, " cell"]
    nearest: Int[Array, " cell"]
    inverse: Float[Array, "segment 3 3"]
    rms_rad: Float[Array, "2"]
    shape: tuple[int, int] = eqx.field(static=True)
    count: int = eqx.field(static=True)
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        grid: Grid,
        light: Float[np.ndarray, "y x"],
        labels: Int[np.ndarray, "y x"],
        *,
        piston_rms_rad: float,
        tilt_rms_rad: float,
        dtype: str = "float64",
    ) -> "SegmentSteps":
        """Precompute ramps and fits.

        Args:
            grid: Cells of the phase.
            light: Light of each over that of a full one.
            labels: Segment of each, from 0.
            piston_rms_rad: Expected.
            tilt_rms_rad: Expected along one axis, rms over a disc as wide as the segment.
            dtype: Precision.
        """
        flat, count = labels.ravel(), int(labels.max()) + 1
        seen = np.where(light > LIT, light, 0).ravel()
        full = np.maximum(np.bincount(flat, seen, count), 1e-9)
        ramps = []
        for axis_m in np.broadcast_arrays(grid.y_m, grid.x_m):
            from_middle_m = axis_m.ravel() - (np.bincount(flat, seen * axis_m.ravel(), count) / full)[flat]
            ramps.append(from_middle_m)
        area = np.bincount(flat, np.sqrt(np.maximum(light, 0)).ravel(), count)  # the amplitude is the share of a cell
        radius_m = np.sqrt(np.maximum(area, 1) / np.pi) * grid.pixel_m
        y, x = (2 * ramp_m / radius_m[flat] for ramp_m in ramps)  # Noll's tilt of unit rms is 2 r / R
        basis = np.stack([np.ones_like(y), y, x])
        gram = np.array([[np.bincount(flat, seen * a * b, count) for a in basis] for b in basis])
        inverse = np.linalg.pinv(np.moveaxis(gram, 2, 0), hermitian=True, rcond=1e-6)
        kept = {"y": y, "x": x, "light": seen, "inverse": inverse, "rms_rad": [piston_rms_rad, tilt_rms_rad]}
        return cls(
            **{name: jnp.asarray(value, dtype) for name, value in kept.items()},
            labels=jnp.asarray(flat),
            nearest=jnp.asarray(_nearest_of_segment(seen.reshape(labels.shape) > 0, labels).ravel()),
            shape=grid.shape,
            count=count,
            pairs=neighbours(labels),
        )

    def phase_rad(self, steps: Float[Array, " step"]) -> Float[Array, "y x"]:
        """The phase of these steps, in units of what is expected."""
        piston, tilt_y, tilt_x = steps.reshape(3, self.count)
        ramps = tilt_y[self.labels] * self.y + tilt_x[self.labels] * self.x
        return (self.rms_rad[0] * piston[self.labels] + self.rms_rad[1] * ramps).reshape(self.shape)

    def transposed(self, gradient: Float[Array, "y x"]) -> Float[Array, " step"]:
        """The transpose of `phase_rad`."""
        sums = self._sums(gradient.ravel())
        return jnp.concatenate([self.rms_rad[0] * sums[0], self.rms_rad[1] * sums[1], self.rms_rad[1] * sums[2]])

    def fitted(self, phase_rad: Float[Array, "y x"]) -> Float[Array, " step"]:
        """The steps that are nearest to a phase on the light of each segment."""
        sums = self._sums(self.light * phase_rad.ravel())
        straight = jnp.einsum("sab,bs->as", self.inverse, sums)
        widths = jnp.maximum(self.rms_rad, jnp.finfo(self.rms_rad.dtype).tiny)
        known = (self.rms_rad > 0).astype(straight.dtype)
        scale = (known / widths)[jnp.array([0, 1, 1])]
        return (scale[:, None] * straight).reshape(-1)

    def spread(self, phase_rad: Float[Array, "y x"]) -> Float[Array, "y x"]:
        """A phase that each dark cell takes over from the nearest lit one of its segment."""
        return phase_rad.ravel()[self.nearest].reshape(self.shape)

    def squares(self) -> Float[Array, " step"]:
        """Sum of the square of each step over the light."""
        lit = [self._sums(self.light)[0], self._sums(self.light * self.y)[1], self._sums(self.light * self.x)[2]]
        scales = self.rms_rad[jnp.array([0, 1, 1])] ** 2
        return jnp.concatenate([scale * one for scale, one in zip(scales, lit, strict=True)])

    def mean_turns(self, phase_rad: Float[Array, "y x"]) -> Float[Array, "y x"]:
        """On the cells of each segment the direction of the mean phasor of its light, within half a turn."""
        phase_rad = phase_rad.ravel()
        real, imaginary = (
            jax.ops.segment_sum(self.light * part, self.labels, self.count)
            for part in (jnp.cos(phase_rad), jnp.sin(phase_rad))
        )
        return jnp.arctan2(imaginary, real)[self.labels].reshape(self.shape)

    def means(self, phase_rad: Float[Array, "y x"]) -> Float[Array, "y x"]:
        """On the cells of each segment the mean phase over its light."""
        sums = jax.ops.segment_sum(self.light * phase_rad.ravel(), self.labels, self.count)
        full = jax.ops.segment_sum(self.light, self.labels, self.count)
        return (sums / jnp.maximum(full, jnp.finfo(full.dtype).tiny))[self.labels].reshape(self.shape)

    def _sums(self, values: Float[Array, " cell"]) -> Float[Array, "3 segment"]:
        parts = (values, values * self.y, values * self.x)
        return jnp.stack([jax.ops.segment_sum(part, self.labels, self.count) for part in parts])


def steps_of(geometry: SensorGeometry, level: Level, prior: PriorSettings, *, dtype: str) -> SegmentSteps | None:
    """The steps of a sensor's pupil on the cells of its model; None for a pupil of one piece.

    Examples:
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> from nlcwfs.beam.segment_layouts import sparse
        >>> from nlcwfs.estimation.ladder import finest_level
        >>> geometry = SensorGeometry(PupilShape(8.0, segments=sparse()), Grid((32, 32), 0.25), 0.65e-6, (3e6,))
        >>> level = finest_level(geometry, Turbulence(0.2), oversampling=1, window=1.2, dtype="float32")
        >>> steps_of(geometry, level, PriorSettings(), dtype="float32").count
        4
    """
    labels = geometry.pupil.labels(level.grid)
    if labels is None:
        return None
    to_rad = 2e-9 * np.pi / geometry.wavelength_m
    return SegmentSteps.build(
        level.grid,
        np.asarray(level.light, float),
        labels,
        piston_rms_rad=prior.segment_piston_nm * to_rad,
        tilt_rms_rad=prior.segment_tilt_nm * to_rad,
        dtype=dtype,
    )


def neighbours(labels: Int[np.ndarray, "y x"]) -> tuple[tuple[int, int], ...]:
    """Every two segments of a few; of more than `ALL_PAIRS_UP_TO` those that share a border.

    Args:
        labels: Segment of each cell, lit or dark, from 0.

    Examples:
        >>> neighbours(np.array([[0, 0, 1, 2]])), len(neighbours(np.arange(16).reshape(4, 4)))
        (((0, 1), (0, 2), (1, 2)), 24)
    """
    count = int(labels.max()) + 1
    if count <= ALL_PAIRS_UP_TO:
        return tuple(itertools.combinations(range(count), 2))
    beside = [(labels[1:], labels[:-1]), (labels[:, 1:], labels[:, :-1])]
    both = np.concatenate([np.stack([one.ravel(), other.ravel()], axis=1) for one, other in beside])
    unlike = np.unique(np.sort(both[both[:, 0] != both[:, 1]], axis=1), axis=0)
    return tuple((int(one), int(other)) for one, other in unlike)


def _nearest_of_segment(lit: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Place of the nearest lit cell; of the cell's own segment where that has light."""
    place = np.arange(lit.size).reshape(lit.shape)
    rows, columns = np.asarray(scipy.ndimage.distance_transform_edt(~lit, return_distances=False, return_indices=True))
    nearest = place[rows, columns]
    wrong = np.flatnonzero(labels.ravel()[nearest.ravel()] != labels.ravel())
    at, flat = np.stack(np.unravel_index(place.ravel(), lit.shape), axis=1), nearest.ravel()
    order = np.argsort(labels.ravel(), kind="stable")
    bright = order[lit.ravel()[order]]
    for number in np.unique(labels.ravel()[wrong]):
        own = bright[slice(*np.searchsorted(labels.ravel()[bright], (number, number + 1)))]
        cells = wrong[labels.ravel()[wrong] == number]
        if own.size:
            flat[cells] = own[scipy.spatial.KDTree(at[own]).query(at[cells])[1]]
    return flat.reshape(lit.shape)
