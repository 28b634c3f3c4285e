"""The shapes that a mirror can take, on the pixels that light reaches."""

import math

import numpy as np
from jaxtyping import Bool, Float

from nlcwfs.beam.disc_harmonics import modes_up_to
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import DIM, ModalBasis, modal_basis
from nlcwfs.beam.zernike import noll_to_nm, zernikes
from nlcwfs.errors import SamplingError
from nlcwfs.mirror.settings import MirrorSettings

REACH = 1.0
"""An actuator is there when a lit pixel lies within so many pitches of it."""

NEW_TO_THE_PUPIL = 1e-8
"""A Zernike is refused when less than this part of it is new: rounding would draw its shape."""

TILT_CPA = 0.5
"""A ramp over the aperture is half a period."""

Shapes = tuple[Float[np.ndarray, "pixel mode"], Float[np.ndarray, " mode"]]
"""Shapes on the lit pixels, and the cycles per aperture of each."""


def karhunen_loeve_shapes(
    settings: MirrorSettings, pupil: Float[np.ndarray, "y x"], grid: Grid, *, diameter_m: float
) -> Shapes:
    """The modes that turbulence excites independently, strongest first; orthonormal on the light.

    Raises:
        SamplingError: If the pixels cannot carry so many modes.

    Examples:
        >>> from nlcwfs.beam.pupil import circular_pupil
        >>> grid = Grid((24, 24), pixel_m=0.4)
        >>> pupil = circular_pupil(grid, diameter_m=8.0)
        >>> shapes, cycles = karhunen_loeve_shapes(MirrorSettings(cutoff_cpa=4.0), pupil, grid, diameter_m=8.0)
        >>> shapes.shape[1], bool(cycles.max() <= 4)
        (42, True)
    """
    if settings.modes is not None:
        basis = modal_basis(pupil, grid, diameter_m=diameter_m, count=settings.modes)
    else:
        basis = _basis_up_to(settings.cutoff_cpa, pupil, grid, diameter_m)
    lit = np.asarray(basis.weights) > 0
    return np.asarray(basis.modes)[:, lit].T, np.asarray(basis.cycles_per_aperture)


def zernike_shapes(
    settings: MirrorSettings, weights: Float[np.ndarray, "y x"], grid: Grid, *, diameter_m: float
) -> Shapes:
    """Zernikes from Noll 2 on, each cleaned of those before it: orthonormal on the light.

    On a clear disc they are the Zernikes themselves but for the pixels, on an annulus those of Mahajan (1981,
    JOSA 71, 75). Their Fourier transforms are too wide for one frequency: a radial order counts as the frequency
    up to which a disc has as many waves, `(pi c)^2 / 4 + pi c / 2` (Weyl), and orders are taken whole.

    Raises:
        SamplingError: If the pupil cannot tell so many Zernikes apart.

    Examples:
        >>> from nlcwfs.beam.pupil import circular_pupil, light_weights
        >>> grid = Grid((24, 24), pixel_m=0.4)
        >>> weights = light_weights(circular_pupil(grid, diameter_m=8.0))
        >>> settings = MirrorSettings(kind="zernike", cutoff_cpa=4.0)
        >>> zernike_shapes(settings, weights, grid, diameter_m=8.0)[0].shape[1]  # eight radial orders
        44
    """
    order = 1
    if settings.modes is None:
        while _cycles_of_order(order + 1) <= settings.cutoff_cpa:
            order += 1
    count = settings.modes or order * (order + 3) // 2
    lit = weights > 0
    root = np.sqrt(weights[lit])[:, None]
    if count >= root.size:
        raise SamplingError("mirror.modes", f"must be below the {root.size} lit pixels", count)
    columns = zernikes(count + 1, grid, diameter_m=diameter_m)[:, lit].T * root
    length = np.linalg.norm(columns, axis=0)
    columns, triangle = np.linalg.qr(columns)
    new = np.diag(triangle)
    if np.any(np.abs(new) < NEW_TO_THE_PUPIL * length):
        first = int(np.argmax(np.abs(new) < NEW_TO_THE_PUPIL * length))
        raise SamplingError("mirror.modes", f"must be below {first}, what the pupil can tell apart", count)
    columns *= np.sign(new)
    cycles = np.array([_cycles_of_order(noll_to_nm(noll)[0]) for noll in range(2, count + 2)])
    return columns[:, 1:] / root, cycles


def fourier_shapes(settings: MirrorSettings, lit: Bool[np.ndarray, "y x"], grid: Grid, *, diameter_m: float) -> Shapes:
    """Tip, tilt, then cosines and sines that fit a whole number of times into the square around the pupil.

    Waves have unit rms over the square, ramps over the disc. What is periodic has no slope, hence the ramps.

    Examples:
        >>> settings = MirrorSettings(kind="fourier", modes=6)
        >>> shapes, cycles = fourier_shapes(settings, np.ones((8, 8), bool), Grid((8, 8), 1.0), diameter_m=8.0)
        >>> cycles.tolist()
        [0.5, 0.5, 1.0, 1.0, 1.0, 1.0]
    """
    y, x = (axis[lit][:, None] / diameter_m for axis in np.broadcast_arrays(grid.y_m, grid.x_m))
    farthest = settings.cutoff_cpa
    if settings.modes is not None:
        farthest = math.sqrt(settings.modes / math.pi) + 2  # a circle of so many points of the lattice, and a rim
    steps = np.arange(-math.floor(farthest), math.floor(farthest) + 1)
    v, u = (each.ravel() for each in np.meshgrid(steps, steps, indexing="ij"))
    half = ((v > 0) | ((v == 0) & (u > 0))) & (np.hypot(v, u) <= farthest)
    order = np.lexsort((u[half], v[half], np.hypot(v, u)[half]))
    v, u = v[half][order], u[half][order]
    phase_rad = 2 * np.pi * (y * v + x * u)
    waves = np.sqrt(2) * np.stack([np.cos(phase_rad), np.sin(phase_rad)], axis=2).reshape(len(y), -1)
    ramps = 4 * np.hstack([x, y])  # unit rms over a disc of diameter 1
    cycles = np.concatenate([[TILT_CPA, TILT_CPA], np.repeat(np.hypot(v, u), 2)])
    return np.hstack([ramps, waves])[:, : settings.modes], cycles[: settings.modes]


def actuator_shapes(settings: MirrorSettings, lit: Bool[np.ndarray, "y x"], grid: Grid, *, diameter_m: float) -> Shapes:
    """Gaussians on a square grid of actuators, those that reach the light; row by row from the smallest y.

    Half a period over two pitches is the fastest that they can do: their cycles per aperture are all that number.

    Examples:
        >>> settings = MirrorSettings(kind="actuators", actuators_across=3, coupling=0.2)
        >>> grid = Grid((1, 3), pixel_m=1.0)
        >>> shapes, _ = actuator_shapes(settings, np.ones((1, 3), bool), grid, diameter_m=2.0)
        >>> shapes[:, 3:6].round(3)  # the middle row of the three
        array([[1.   , 0.2  , 0.002],
               [0.2  , 1.   , 0.2  ],
               [0.002, 0.2  , 1.   ]])
    """
    pitch_m = diameter_m / (settings.actuators_across - 1)
    places = np.arange(settings.actuators_across) - (settings.actuators_across - 1) / 2
    y, x = (axis[lit][:, None] / pitch_m for axis in np.broadcast_arrays(grid.y_m, grid.x_m))
    away_y, away_x = (y - places) ** 2, (x - places) ** 2
    near = np.array([np.min(away_y[:, [i]] + away_x, axis=0) for i in range(len(places))]) <= REACH**2 * (1 + 1e-9)
    row, column = np.nonzero(near)
    # A Gaussian of two axes is a product of two: far fewer exponentials.
    along_y, along_x = settings.coupling**away_y, settings.coupling**away_x
    cycles = (settings.actuators_across - 1) / 2
    return along_y[:, row] * along_x[:, column], np.full(len(row), cycles)


def _basis_up_to(cutoff_cpa: float, pupil: np.ndarray, grid: Grid, diameter_m: float) -> ModalBasis:
    """Karhunen-Loeve modes up to a frequency: those of a disc by the share of the area, then more if need be.

    On separate discs the last modes depend on those beyond them: of 99 modes up to 10 cycles per aperture on four
    discs, 91 are found among 100, 95 among 160 and 99 among 200. Hence the more to spare, the sparser the pupil.
    """
    share = min(1.0, float(np.sum(pupil >= DIM)) * grid.pixel_m**2 / (math.pi / 4 * diameter_m**2))
    count = math.ceil((1.03 + 3 * (1 - share) ** 2) * share * modes_up_to(cutoff_cpa)) + 5
    while True:
        try:
            basis = modal_basis(pupil, grid, diameter_m=diameter_m, count=count)
        except SamplingError as error:
            rule = "must be lower, for the lit pixels do not carry all its modes"
            raise SamplingError("mirror.cutoff_cpa", rule, cutoff_cpa) from error
        if basis.cycles_per_aperture[-1] > cutoff_cpa:
            return basis.up_to(cutoff_cpa)
        count = math.ceil(1.2 * count)


def _cycles_of_order(order: int) -> float:
    """The frequency up to which a disc has as many waves as there are Zernikes up to a radial order."""
    return (math.sqrt(1 + 2 * order * (order + 3)) - 1) / math.pi
