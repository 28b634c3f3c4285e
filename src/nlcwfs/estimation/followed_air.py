"""The air behind frames that follow each other: what one frame leaves of it is expected of the next."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.frame_prediction import (
    lasting_correlation,
    posterior_power,
    predicted_mean_and_power,
    unseen_share,
    wind_carriage,
)
from nlcwfs.estimation.gauss_newton import Problem
from nlcwfs.estimation.prior_settings import PriorSettings
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.estimation.sequence_memory import Memory
from nlcwfs.estimation.turbulence_filter import rms_of_power
from nlcwfs.estimation.wave_sensitivity import LAGS
from nlcwfs.estimation.whitened_phase import Unknown, WhitenedPhase

TRUST = 0.8
"""Share of the prediction in what is expected; the rest is air that has never been seen. Air comes in over the rim of
the pupil, which a filter that is diagonal in Fourier space cannot know: without it a loop that knows its wind ends at
143 nm, with nine tenths at 72 (`bench/closed_loop.py`)."""


class ExpectedAir(eqx.Module):
    """What is expected of a phase before anything was seen.

    Attributes:
        power: Expected power of each wave, for turbulence of strength 1.
        tilt_rms_rad: Expected rms of the tilt along one axis, for strength 1.
        grid: Cells of the phase.
        diameter_m: Of the telescope.
        wavelength_m: At which the phase counts.
    """

    power: Float[Array, "y fx"]
    tilt_rms_rad: Float[Array, ""]
    grid: Grid = eqx.field(static=True)
    diameter_m: float = eqx.field(static=True)
    wavelength_m: float = eqx.field(static=True)


class FollowedAir(eqx.Module):
    """How the phase of the whole turbulence goes on from frame to frame, whatever the sensor.

    Attributes:
        whole: What is expected of it all.
        correlation: How much of each wave a frame shows again.
        tilt_correlation: The same for the tilt.

    Examples:
        What no frame has shown for long is all of the turbulence.

        >>> one = jnp.ones(())
        >>> whole = ExpectedAir(4 * jnp.ones((8, 5)), one, Grid((8, 8), 1.0), diameter_m=8.0, wavelength_m=0.85e-6)
        >>> air = FollowedAir.build(whole, PriorSettings(), interval_s=0.01, information=1.0)
        >>> seen = dataclasses.replace(air.unseen(one, jnp.zeros(2), PlaneScale(one, one)), left_open=jnp.zeros((8, 5)))
        >>> for _ in range(40):
        ...     seen = air.expected(seen)
        >>> seen.left_open.round(1).tolist()[1]
        [4.0, 4.0, 4.0, 4.0, 4.0]
    """

    whole: ExpectedAir
    correlation: Float[Array, "y fx"] | Complex[Array, "y fx"]
    tilt_correlation: float = eqx.field(static=True)

    @classmethod
    def build(cls, whole: ExpectedAir, prior: PriorSettings, *, interval_s: float, information: float) -> "FollowedAir":
        """What the wind leaves of the phase until the next frame.

        Args:
            whole: What is expected of the whole turbulence.
            prior: The wind, whose direction may be unknown.
            interval_s: Time from frame to frame.
            information: Of a frame on the phase of one cell, 1/rad^2.
        """
        speed, grid, dtype = prior.wind_speed_m_per_s, whole.grid, whole.power.dtype
        if prior.wind_direction_deg is None:
            power = np.asarray(whole.power, float)
            wind = {"wind_m_per_s": speed, "interval_s": interval_s}
            again = lasting_correlation(grid, power, information=information, **wind)
        else:
            angle = np.deg2rad(prior.wind_direction_deg)
            again = wind_carriage(grid, [(1.0, speed * np.sin(angle), speed * np.cos(angle))], interval_s=interval_s)
        new = unseen_share(diameter_m=whole.diameter_m, wind_m_per_s=speed, interval_s=interval_s)
        moved = np.pi * speed * interval_s / whole.diameter_m
        again = np.asarray(again) * np.sqrt(1 - new)
        kind = np.result_type(dtype, np.complex64) if np.iscomplexobj(again) else dtype
        return cls(whole, jnp.asarray(again, kind), float(np.exp(-(moved**2) / 2)))

    def unseen(self, strength: Float[Array, ""], slope: Float[Array, "2"], scale: PlaneScale) -> Memory:
        """What is known before the first frame: nothing but the strength of the turbulence and a tilt."""
        return Memory(
            phase_rad=jnp.zeros(self.whole.grid.shape, self.whole.power.dtype),
            slope=slope,
            left_open=self.whole.power * strength,
            tilt_left_rad=self.whole.tilt_rms_rad * jnp.sqrt(strength),
            strength=strength,
            scale=scale,
            surprise_rad2=jnp.zeros(len(LAGS), strength.dtype),
        )

    def expected(self, memory: Memory) -> Memory:
        """What is expected one interval later."""
        power = self.whole.power * memory.strength
        mean_rad, left_open = predicted_mean_and_power(memory.phase_rad, memory.left_open, power, self.correlation)
        left_open = TRUST * left_open + (1 - TRUST) * power
        again = self.tilt_correlation**2
        tilt = self.whole.tilt_rms_rad**2 * memory.strength
        tilt_left_rad = jnp.sqrt(again * memory.tilt_left_rad**2 + (1 - again) * tilt)
        return dataclasses.replace(memory, phase_rad=mean_rad, left_open=left_open, tilt_left_rad=tilt_left_rad)

    def left_rad2(self, memory: Memory) -> Float[Array, ""]:
        """Variance of what is left open of waves and tilt."""
        return rms_of_power(memory.left_open, self.whole.grid) ** 2 + 2 * memory.tilt_left_rad**2

    def prior(self, expected: Memory) -> WhitenedPhase:
        """Unknowns for what is open beside the expected mean."""
        return WhitenedPhase.build(
            self.whole.grid, expected.left_open, tilt_rms_rad=expected.tilt_left_rad, diameter_m=self.whole.diameter_m
        )

    def seen(self, expected: Memory, problem: Problem, unknown: Unknown, lit: Float[Array, ""]) -> Memory:
        """What is known when a frame was looked at.

        Args:
            expected: Beforehand; its prior is that of the problem.
            problem: The frame.
            unknown: Its solution.
            lit: Cells with light, in fully lit ones.
        """
        wave = Unknown(unknown.waves, jnp.zeros_like(unknown.slope))
        rms_rad, power = expected.tilt_left_rad, expected.left_open
        # A tilt of unit rms over a disc is 2 r / R (Noll).
        moved = unknown.slope * rms_rad * (4 / self.whole.diameter_m * self.whole.wavelength_m / (2 * np.pi))
        shown = problem.information * problem.shown.slope[0] * lit
        return dataclasses.replace(
            expected,
            phase_rad=expected.phase_rad + problem.prior.phase_rad(wave),
            slope=expected.slope + moved,
            left_open=posterior_power(power, problem.information * problem.shown.waves),
            tilt_left_rad=jnp.sqrt(rms_rad**2 / (1 + rms_rad**2 * shown)),
        )
