"""A mirror that adds the shapes it knows, each as far as it is commanded."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import DIM
from nlcwfs.beam.pupil import light_weights, nearest_lit
from nlcwfs.errors import SamplingError, SettingsError
from nlcwfs.mirror.settings import MirrorSettings
from nlcwfs.mirror.shapes import actuator_shapes, fourier_shapes, karhunen_loeve_shapes, zernike_shapes

WORTH_FITTING = 0.05
"""Combinations of Fourier modes or actuators that move the light less than this part of the most effective one
are left at rest: noise in a command grows by 1 / 0.05 at most. Measured, 17 actuators across, Kolmogorov screens:
at 0.2, 0.1, 0.05, 0.005 the best fit leaves 0.39, 0.30, 0.24, 0.24 (d / r0)^(5/3) rad^2 at a pitch d, and white noise
moves the actuators 1, 1.3, 2, 5 times as far; for Fourier modes 0.98, 0.84, 0.27, 0.26 and 1, 1.3, 2, 11."""

EXACT = jax.lax.Precision.HIGHEST
"""Accelerators round the factors of a product to 11 bits unless told otherwise: 0.05 % of a micrometre."""


class Mirror(eqx.Module):
    """A deformable mirror on one pupil; built by `Mirror.build`.

    Shapes have zero mean over the light: a mirror here neither makes nor sees piston. Karhunen-Loeve modes and
    Zernikes are orthonormal on the light, so a command is the rms of its mode. Fourier modes are redundant on a
    disc, and actuators beyond the edge are hardly seen: for these the fit drops the combinations that move the
    light less than `WORTH_FITTING`, and gives the shortest command of those that fit as well.

    Attributes:
        shapes: OPD in m for a command of 1 m of every mode, at the lit pixels. Rim pixels below the amplitude
            `beam.modes.DIM` take the shape of their nearest neighbour.
        fit: What the OPD of every lit pixel adds to the best command; zero for the dim ones.
        rows: Row of every lit pixel.
        columns: Column of every lit pixel.
        cycles_per_aperture: Spatial frequency of every mode.
        shape: Pixels along y and x.
        stroke_m: Largest command to either side; infinite without limit.
        condition: Ratio of the most to the least effective combination of commands that the fit uses.
        rank: How many independent combinations it uses.
    """

    shapes: Float[Array, "mode lit"]
    fit: Float[Array, "mode lit"]
    rows: Int[Array, " lit"]
    columns: Int[Array, " lit"]
    cycles_per_aperture: Float[np.ndarray | Array, " mode"]
    shape: tuple[int, int] = eqx.field(static=True)
    stroke_m: float = eqx.field(static=True)
    condition: float = eqx.field(static=True)
    rank: int = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        settings: MirrorSettings,
        pupil: Float[np.ndarray, "y x"],
        grid: Grid,
        *,
        diameter_m: float,
        dtype: str = "float32",
    ) -> "Mirror":
        """Make the shapes of a mirror on the pupil at hand, and the matrix that fits them.

        Args:
            settings: Kind and number of its shapes.
            pupil: Amplitude from 0 to 1.
            grid: Pixels of the pupil.
            diameter_m: Aperture of `cutoff_cpa`; the outermost actuators stand on its edge.
            dtype: Precision of the matrices; they are made in double precision.

        Raises:
            SamplingError: If the pixels cannot carry so fine shapes, or so many.
            SettingsError: If the diameter is not positive.

        Examples:
            >>> from nlcwfs.beam.pupil import circular_pupil
            >>> grid = Grid((24, 24), pixel_m=0.4)
            >>> pupil = circular_pupil(grid, diameter_m=8.0)
            >>> mirror = Mirror.build(MirrorSettings(modes=20), pupil, grid, diameter_m=8.0)
            >>> command_m = np.linspace(-1e-7, 1e-7, 20)
            >>> bool(np.allclose(mirror.fitted(mirror.opd_m(command_m)), command_m, atol=1e-12))
            True
        """
        if not (diameter_m > 0 and math.isfinite(diameter_m)):
            raise SettingsError("diameter_m", "must be a positive length", diameter_m)
        _check_sampling(settings, diameter_m / grid.pixel_m)
        weights = light_weights(np.where(pupil < DIM, 0, pupil))
        bright, lit = weights > 0, pupil > 0
        light = weights[bright]
        if settings.kind in ("karhunen-loeve", "zernike"):
            if settings.kind == "karhunen-loeve":
                shapes, cycles = karhunen_loeve_shapes(settings, pupil, grid, diameter_m=diameter_m)
            else:
                shapes, cycles = zernike_shapes(settings, weights, grid, diameter_m=diameter_m)
            fit, condition, rank = shapes.T * light, 1.0, shapes.shape[1]
        else:
            make = fourier_shapes if settings.kind == "fourier" else actuator_shapes
            shapes, cycles = make(settings, bright, grid, diameter_m=diameter_m)
            shapes = shapes - light @ shapes
            fit, condition, rank = _least_squares(shapes, light)
        rows, columns = np.nonzero(lit)
        return cls(
            shapes=jnp.asarray(shapes.T[:, nearest_lit(bright)[lit]], dtype),
            fit=jnp.asarray(_spread(fit, bright[lit], dtype)),
            rows=jnp.asarray(rows),
            columns=jnp.asarray(columns),
            cycles_per_aperture=cycles,
            shape=(grid.shape[0], grid.shape[1]),
            stroke_m=math.inf if settings.stroke_um is None else settings.stroke_um * 1e-6,
            condition=condition,
            rank=rank,
        )

    @property
    def count(self) -> int:
        """Number of modes or actuators: the length of a command."""
        return self.shapes.shape[0]

    def clipped(self, command_m: Float[Array | np.ndarray, " mode"]) -> Float[Array, " mode"]:
        """What becomes of a command: no entry goes beyond the stroke."""
        command_m = jnp.asarray(command_m, self.shapes.dtype)
        return command_m if math.isinf(self.stroke_m) else jnp.clip(command_m, -self.stroke_m, self.stroke_m)

    def opd_m(self, command_m: Float[Array | np.ndarray, " mode"]) -> Float[Array, "y x"]:
        """The OPD that the mirror adds, the command clipped; zero where there is no light."""
        values_m = jnp.matmul(self.clipped(command_m), self.shapes, precision=EXACT)
        return jnp.zeros(self.shape, values_m.dtype).at[self.rows, self.columns].set(values_m)

    def fitted(self, opd_m: Float[Array | np.ndarray, "y x"]) -> Float[Array, " mode"]:
        """The command that comes closest to a wavefront, on the mean over the light; not clipped.

        Subtract its shape, or command its negative, to flatten the wavefront.
        """
        opd_m = jnp.asarray(opd_m, self.fit.dtype)
        return jnp.matmul(self.fit, opd_m[self.rows, self.columns], precision=EXACT)


def _check_sampling(settings: MirrorSettings, pixels: float) -> None:
    if settings.kind == "actuators":
        if settings.actuators_across - 1 > pixels * (1 + 1e-9):
            rule = f"must be at most {math.floor(pixels) + 1}, one for each pixel of the telescope"
            raise SamplingError("mirror.actuators_across", rule, settings.actuators_across)
    elif settings.modes is None and settings.cutoff_cpa > pixels / 2:
        rule = f"must be at most {pixels / 2:g}, half a cycle for each pixel of the telescope"
        raise SamplingError("mirror.cutoff_cpa", rule, settings.cutoff_cpa)


def _least_squares(
    shapes: Float[np.ndarray, "pixel mode"], light: Float[np.ndarray, " pixel"]
) -> tuple[Float[np.ndarray, "mode pixel"], float, int]:
    """Truncated pseudo-inverse, its condition and its rank.

    By the eigenvectors of the normal equations, six times faster than a singular value decomposition; what they
    cannot resolve (1e-8) is far below what is cut.
    """
    weighted = shapes.T * light
    strength, vectors = np.linalg.eigh(weighted @ shapes)
    keep = strength > WORTH_FITTING**2 * strength[-1]
    inverse = (vectors[:, keep] / strength[keep]) @ vectors[:, keep].T
    return inverse @ weighted, float(np.sqrt(strength[-1] / strength[keep][0])), int(keep.sum())


def _spread(fit: Float[np.ndarray, "mode pixel"], seen: np.ndarray, dtype: str) -> np.ndarray:
    """The same columns among all lit pixels, zero for those that are not seen."""
    full = np.zeros((fit.shape[0], seen.size), dtype)
    full[:, seen] = fit
    return full
