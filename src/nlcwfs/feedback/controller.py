"""One interface for every way from measurements to commands, as a loop uses it."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float

from nlcwfs.errors import SettingsError
from nlcwfs.feedback.integrator import Integrator
from nlcwfs.feedback.loop_transfer import IntegratorLoop, mirror_transfer
from nlcwfs.feedback.modal_gains import optimal_gains
from nlcwfs.feedback.predictor import Predictor
from nlcwfs.feedback.settings import FeedbackSettings
from nlcwfs.feedback.state import FeedbackState


class Telemetry(eqx.Module):
    """What a loop has recorded, one row for each exposure.

    Attributes:
        measured_m: What was measured of each mode.
        mirror_m: Mean shape of the mirror over the same exposure; zero in open loop.
    """

    measured_m: Float[Array, "frame mode"] | Float[np.ndarray, "frame mode"]
    mirror_m: Float[Array, "frame mode"] | Float[np.ndarray, "frame mode"]

    @property
    def open_loop_m(self) -> Float[np.ndarray, "frame mode"]:
        """What would have been measured without a mirror."""
        return np.asarray(self.measured_m, float) + np.asarray(self.mirror_m, float)


class Controller(eqx.Module):
    """From the measurement of each exposure to a command.

    A loop shows each exposure the mirror of `state.line`, records that line's `mean_m` beside what it measured, and
    steps. After a while it learns; the state goes on as it is. A new controller has to be compiled once.

    Attributes:
        law: How commands are made.
        settings: What the user chose.
        rate_hz: Exposures per second.

    Examples:
        >>> import jax.numpy as jnp
        >>> controller = Controller.build(FeedbackSettings(latency_frames=1.0), 2, 500.0)
        >>> state = controller.init()
        >>> state, command_m = controller.step(state, jnp.array([3e-8, -1e-8]))
        >>> command_m.tolist() == state.line.newest_m.tolist(), state.line.mean_m.tolist()  # still on its way
        (True, [0.0, 0.0])
    """

    law: Integrator | Predictor
    settings: FeedbackSettings = eqx.field(static=True)
    rate_hz: float = eqx.field(static=True)

    @classmethod
    def build(cls, settings: FeedbackSettings, modes: int, rate_hz: float, *, dtype: str = "float32") -> "Controller":
        """An integrator; `learn` makes of it what the settings ask for.

        Args:
            settings: What the user chose.
            modes: How many modes the mirror has.
            rate_hz: Exposures per second.
            dtype: Precision of the commands.

        Raises:
            SettingsError: If the gain is not stable for the latency, or the rate or the modes are not positive.
        """
        if not rate_hz > 0 or not modes > 0:
            raise SettingsError("rate_hz and modes", "must be positive", (rate_hz, modes))
        loop = IntegratorLoop(settings.latency_frames, settings.leak, settings.pseudo_open_loop)
        integrator = Integrator.build(np.full(modes, settings.gain), loop=loop, dtype=dtype)
        learns_taps = settings.controller == "predictive"
        law = Predictor(integrator, settings.prediction_order) if learns_taps else integrator
        return cls(law, settings, float(rate_hz))

    def init(self) -> FeedbackState:
        """A flat mirror, and nothing seen."""
        return self.law.init()

    def step(
        self, state: FeedbackState, measured_m: Float[Array, " mode"]
    ) -> tuple[FeedbackState, Float[Array, " mode"]]:
        """From the measurement of an exposure to the next command.

        Args:
            state: What the last step left; its `line` is the mirror during the exposure.
            measured_m: Residual of each mode, air less mirror.

        Returns:
            The state of the next exposure, and the command that was computed for it. With latency the mirror of the
            next exposure is not yet this command but what `line` of the state tells.
        """
        return self.law.step(state, measured_m)

    def skip(self, state: FeedbackState) -> tuple[FeedbackState, Float[Array, " mode"]]:
        """An exposure that measured nothing, or nothing that is believed."""
        return self.law.skip(state)

    def learn(self, telemetry: Telemetry) -> "Controller":
        """A controller with gains or predictions from what was recorded in open or closed loop.

        Of a plain integrator nothing is learnt.

        Args:
            telemetry: What was recorded; the last `training_frames` count.

        Raises:
            SettingsError: If there are too few frames.
        """
        kept = telemetry.open_loop_m[-self.settings.training_frames :]
        if isinstance(self.law, Predictor):
            learnt = self.law.learn(kept, forgetting=self.settings.forgetting)
            return Controller(learnt, self.settings, self.rate_hz)
        if self.settings.controller == "integrator":
            return self
        gain = optimal_gains(kept, loop=self.law.loop).gain
        law = Integrator.build(gain, loop=self.law.loop, dtype=str(self.law.gain.dtype))
        return Controller(law, self.settings, self.rate_hz)

    def noise_transfer(self, frequency_hz: Float[np.ndarray, " frequency"]) -> Complex[np.ndarray, "frequency mode"]:
        """Shape of the mirror over the noise of what is measured, in means over exposures; see `loop_transfer`."""
        frequency = np.asarray(frequency_hz, float)[:, None] / self.rate_hz
        if isinstance(self.law, Integrator):
            return self.law.loop.noise_transfer(frequency, np.asarray(self.law.gain, float)[None])
        if self.law.taps is None:
            return self.law.fallback.loop.noise_transfer(frequency, np.asarray(self.law.fallback.gain, float)[None])
        late = np.exp(-2j * np.pi * frequency * np.arange(1, self.law.order + 1))
        mirror = mirror_transfer(frequency, latency_frames=self.settings.latency_frames)
        return mirror * (late @ np.asarray(self.law.taps, float))

    def rejection_transfer(
        self, frequency_hz: Float[np.ndarray, " frequency"]
    ) -> Complex[np.ndarray, "frequency mode"]:
        """Residual over air, in means over exposures."""
        return 1 - self.noise_transfer(frequency_hz)
