"""What a loop leaves of the turbulence, drawn from its statistics: what a sensor meets, and its prior."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis, modal_basis
from nlcwfs.beam.pupil import light_weights
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.config import Config
from nlcwfs.estimation.phase_prior import ClosedLoop, closed_loop_power, lag_share, noise_power
from nlcwfs.simulation.exposure import turbulence, wavelength_m

SPECKLED_LOSS = 2.1
"""Photons that speckled images need over the quantum limit, for the noise of the loop that is drawn (study 01)."""

FINER = 1.25
"""Modes up to so many cutoffs are estimated together with the mirror's: beyond it they pass for each other. With 1.5
the error of the mirror's modes changes by less than 1 % (8 and 16 cycles, 3e6 photons a second)."""

CELLS_PER_CYCLE = 3.75
"""Cells across the pupil for each cycle of the cutoff: three for each cycle of the finest mode."""

FINEST_CPA = 20.0
"""Cutoff up to which information is computed (1600 modes); what lies beyond is taken to be like the last quarter."""

BEYOND = 2 * math.pi * 0.0229 * 0.6
"""Kolmogorov's variance beyond f cycles per aperture is 0.0863 f^(-5/3) (D/r0)^(5/3) (Noll 1976, eq. 21)."""


@dataclass(frozen=True)
class Loop:
    """The air, the mirror and the time of a loop, in numbers.

    Attributes:
        air: The turbulence.
        diameter_m: Of the telescope.
        wavelength_m: Of sensing.
        cutoff_cpa: Finest wave of the mirror.
        wind_m_per_s: Of one layer that lags like all of them: weighted mean of the power 5/3.
        delay_frames: From the middle of an exposure to the middle of its correction.
        photons_per_s: Photo-electrons of the whole sensor in a second.
    """

    air: Turbulence
    diameter_m: float
    wavelength_m: float
    cutoff_cpa: float
    wind_m_per_s: float
    delay_frames: float
    photons_per_s: float

    @classmethod
    def of(cls, config: Config, photons_per_s: float) -> "Loop":
        """That of a configuration.

        Args:
            config: The settings.
            photons_per_s: What the star sends to the detector.

        Examples:
            >>> loop = Loop.of(Config(), 3e6)
            >>> loop.cutoff_cpa, loop.wind_m_per_s, loop.delay_frames
            (16.0, 10.0, 1.0)
        """
        sky, mirror, detector = config.atmosphere, config.mirror, config.detector
        excess = 2 - 1 / detector.em_gain if detector.em_gain > 1 else 1.0
        cutoff_cpa = (mirror.actuators_across - 1) / 2 if mirror.kind == "actuators" else mirror.cutoff_cpa
        if mirror.modes is not None:
            cutoff_cpa = math.sqrt(4 * mirror.modes) / math.pi  # a disc of radius f holds (pi f)^2 / 4 modes
        winds = zip(sky.layer_fractions, sky.wind_speeds_m_per_s, strict=True)
        return cls(
            air=turbulence(config),
            diameter_m=config.beam.diameter_m,
            wavelength_m=wavelength_m(config),
            cutoff_cpa=cutoff_cpa,
            wind_m_per_s=sum(share * speed ** (5 / 3) for share, speed in winds) ** 0.6,
            delay_frames=1 + config.feedback.latency_frames,
            photons_per_s=photons_per_s * detector.quantum_efficiency / excess,
        )

    @property
    def strength(self) -> float:
        """(D / r0)^(5/3) at the wavelength of sensing."""
        return (self.diameter_m / self.air.fried_at(self.wavelength_m)) ** (5 / 3)

    @property
    def radian_m(self) -> float:
        """Path of one radian."""
        return self.wavelength_m / (2 * math.pi)


@dataclass(frozen=True)
class LoopResidual:
    """Wavefronts of a closed loop, and what is known of their modes beforehand.

    Attributes:
        loop: Air, mirror and time.
        grid: Cells of the pupil.
        weights: Share of the light in every cell.
        basis: Karhunen-Loeve modes, the mirror's first.
        turbulent_rad2: Variance of each mode in the open.
        controlled: Number of modes that the mirror takes out; may exceed those of the basis.
        draws_rad: Residuals.
    """

    loop: Loop
    grid: Grid
    weights: Float[np.ndarray, "y x"]
    basis: ModalBasis
    turbulent_rad2: Float[np.ndarray, " mode"]
    controlled: int
    draws_rad: Float[np.ndarray, "draw y x"]

    @classmethod
    def build(cls, loop: Loop, shape: PupilShape) -> "LoopResidual":
        """The modes of a mirror and their statistics; no wavefronts yet, see `redrawn`.

        Args:
            loop: Air, mirror and time.
            shape: The pupil.

        Examples:
            >>> small = Loop(Turbulence(0.2), 1.0, 0.85e-6, 4.0, 10.0, 1.0, photons_per_s=1e6)
            >>> left = LoopResidual.build(small, PupilShape(1.0)).redrawn(rate_hz=500.0, draws=2, seed=0)
            >>> left.controlled, left.draws_rad.shape
            (42, (2, 18, 18))
        """
        sensed = min(loop.cutoff_cpa, FINEST_CPA)
        cells = 2 * math.ceil(CELLS_PER_CYCLE * max(sensed, 4.0) / 2)
        grid = Grid((cells + 2, cells + 2), loop.diameter_m / cells)
        pupil = shape.on(grid)
        weights = light_weights(pupil)
        filled = float(np.sum(pupil**2)) / (np.pi / 4 * cells**2)
        count = math.ceil(filled * (np.pi * FINER * sensed / 2) ** 2)
        basis = modal_basis(pupil, grid, diameter_m=loop.diameter_m, count=count)
        inside = int(np.sum(np.asarray(basis.cycles_per_aperture) <= loop.cutoff_cpa))
        beyond = loop.cutoff_cpa > FINEST_CPA
        return cls(
            loop=loop,
            grid=grid,
            weights=weights,
            basis=basis,
            turbulent_rad2=np.asarray(basis.kolmogorov_rad2, float) * loop.strength,
            controlled=math.ceil(filled * (np.pi * loop.cutoff_cpa / 2) ** 2) if beyond else inside,
            draws_rad=np.zeros((0, *grid.shape)),
        )

    def redrawn(self, *, rate_hz: float, draws: int, seed: int) -> "LoopResidual":
        """The same with other wavefronts: of a rate, so many, of a seed."""
        drawn = _drawn(self.loop, self.grid, self.weights, rate_hz=rate_hz, draws=draws, seed=seed)
        return dataclasses.replace(self, draws_rad=drawn)

    def first(self, draws: int) -> "LoopResidual":
        """The same with its first wavefronts only."""
        return dataclasses.replace(self, draws_rad=self.draws_rad[:draws])

    @property
    def told(self) -> int:
        """Modes of the mirror whose information is computed."""
        return min(self.controlled, self.basis.count)

    def lag_rad2(self, rate_hz: float) -> Float[np.ndarray, " mode"]:
        """What each mode changes from an exposure to its correction."""
        loop = self.loop
        cycles_per_m = np.asarray(self.basis.cycles_per_aperture, float) / loop.diameter_m
        share = lag_share(cycles_per_m, wind_m_per_s=loop.wind_m_per_s, lag_s=loop.delay_frames / rate_hz)
        return self.turbulent_rad2 * share

    def prior_rad2(self, rate_hz: float) -> Float[np.ndarray, " mode"]:
        """Variance of each mode before an exposure: lag and the noise of the last command, or the open air."""
        noise = SPECKLED_LOSS * rate_hz / (4 * self.loop.photons_per_s)
        controlled = np.arange(self.basis.count) < self.controlled
        return np.where(controlled, self.lag_rad2(rate_hz) + noise, self.turbulent_rad2)

    def fitting_rad2(self) -> float:
        """What the mirror cannot make."""
        if self.loop.cutoff_cpa > FINEST_CPA:
            return BEYOND * self.loop.cutoff_cpa ** (-5 / 3) * self.loop.strength
        return self.basis.kolmogorov_total_rad2 * self.loop.strength - float(np.sum(self.turbulent_rad2[: self.told]))


def _drawn(
    loop: Loop, grid: Grid, weights: Float[np.ndarray, "y x"], *, rate_hz: float, draws: int, seed: int
) -> Float[np.ndarray, "draw y x"]:
    wide = grid.padded((3 * grid.shape[0], 3 * grid.shape[1]))
    photons = loop.photons_per_s / rate_hz
    lit_pixels = float(np.sum(weights) ** 2 / np.sum(weights**2))
    left = ClosedLoop(
        cutoff_per_m=loop.cutoff_cpa / loop.diameter_m,
        lag_s=loop.delay_frames / rate_hz,
        wind_m_per_s=loop.wind_m_per_s,
        noise=noise_power(photons, sensor_loss=SPECKLED_LOSS, lit_pixels=lit_pixels),
    )
    root = np.sqrt(closed_loop_power(wide, loop.air, left, wavelength_m=loop.wavelength_m))
    generator = np.random.default_rng(seed)
    drawn = []
    for _ in range(draws):
        white = np.fft.rfft2(generator.standard_normal(wide.shape))
        phase_rad = np.fft.irfft2(white * root, s=wide.shape)[: grid.shape[0], : grid.shape[1]]
        drawn.append(np.where(weights > 0, phase_rad - np.sum(weights * phase_rad), 0))
    return np.array(drawn).reshape(draws, *grid.shape)
