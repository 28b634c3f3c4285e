"""One exposure of the detector: photons on its pixels become frames."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from nlcwfs.detector.converter import adu_to_electrons, at_full_scale, electrons_to_adu
from nlcwfs.detector.electron_multiplication import excess_noise_factor, multiply_electrons
from nlcwfs.detector.photon_noise import sample_poisson
from nlcwfs.detector.settings import DetectorSettings


class Frames(eqx.Module):
    """What the detector gives for one exposure of all planes.

    Attributes:
        electrons: Photo-electrons of every pixel as measured: bias removed, divided by the multiplication,
            background and dark still inside. May be negative (read noise) and fractional.
        saturated: Where the pixel or the converter was full, so that the truth may lie above the measurement.
    """

    electrons: Float[Array, "plane y x"]
    saturated: Bool[Array, "plane y x"]


class Detector(eqx.Module):
    """A camera: reads photons with its noise, and knows the mean and the variance of what it reads.

    Every number is static: two cameras compile twice, and the stages that a camera lacks cost nothing.

    Attributes:
        settings: The camera's numbers.

    Examples:
        >>> camera = Detector(DetectorSettings(preset="qCMOS"))
        >>> frames = camera.read(jnp.full((4, 8, 8), 100.0), jax.random.key(0))
        >>> bool(frames.saturated.any()), round(float(frames.electrons.mean()))
        (False, 55)
    """

    settings: DetectorSettings = eqx.field(static=True)

    def read(self, photons: Float[Array, "plane y x"], key: PRNGKeyArray) -> Frames:
        """Expose once.

        Args:
            photons: Mean photons on every detector pixel in the exposure, see `integrate_on_pixels`.
            key: Random key, used once.

        Returns:
            Frames in the dtype of the photons.

        Examples:
            >>> camera = Detector(DetectorSettings(full_well_electrons=10))
            >>> frames = camera.read(jnp.array([[[1000.0, 0.0]]]), jax.random.key(0))
            >>> frames.electrons, frames.saturated
            (Array([[[10.,  0.]]], dtype=...), Array([[[ True, False]]], dtype=bool))
        """
        key_photon, key_register, key_amplifier = jax.random.split(key, 3)
        well = self.settings.full_well_electrons
        arrived = sample_poisson(key_photon, self.expected_electrons(photons))
        collected = jnp.minimum(arrived, well)
        output = multiply_electrons(key_register, collected, em_gain=self.settings.em_gain)
        if self.settings.read_noise_electrons > 0:
            deviate = jax.random.normal(key_amplifier, output.shape, output.dtype)
            output = output + self.settings.read_noise_electrons * deviate
        adu = self._convert(output)
        saturated = (arrived >= well) | at_full_scale(adu, bits=self.settings.bits)
        return Frames(electrons=self.to_electrons(adu), saturated=saturated)

    def expected_electrons(self, photons: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Mean of `Frames.electrons` without saturation: an estimator's model of the data.

        Args:
            photons: Mean photons on every detector pixel in the exposure.

        Examples:
            >>> settings = DetectorSettings(quantum_efficiency=0.5, background_photons=2, dark_electrons=3)
            >>> camera = Detector(settings)
            >>> camera.expected_electrons(jnp.array([10.0]))
            Array([9.], dtype=...)
        """
        return self.settings.quantum_efficiency * photons + self.background_electrons

    @property
    def variance_without_light(self) -> float:
        """Variance of a pixel that gets no light, electrons before multiplication, squared."""
        return self.settings.read_noise_electrons**2 / self.settings.em_gain**2 + self.background_electrons

    @property
    def background_electrons(self) -> float:
        """Mean electrons of a pixel without starlight; subtract them to see the star alone."""
        return self.settings.quantum_efficiency * self.settings.background_photons + self.settings.dark_electrons

    def variance_electrons(self, mean_electrons: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Variance of `Frames.electrons` without saturation: an estimator's model of the noise.

        Photon noise with the excess of the multiplication, amplifier noise and rounding (a uniform error,
        1/12). Rounding counts as independent noise, which is wrong when a step is far larger than all other
        noise.

        Args:
            mean_electrons: Mean of the same pixels, background and dark included; a negative one, as in a
                measured frame, counts as zero.

        Examples:
            >>> camera = Detector(DetectorSettings(read_noise_electrons=3))
            >>> camera.variance_electrons(jnp.array([16.0]))
            Array([25.], dtype=...)
        """
        s = self.settings
        rounding = s.gain_electrons_per_adu**2 / 12 if s.bits else 0.0
        at_amplifier = s.read_noise_electrons**2 + rounding
        excess = excess_noise_factor(s.em_gain) ** 2
        return excess * jnp.maximum(mean_electrons, 0.0) + at_amplifier / s.em_gain**2

    def to_adu(self, electrons: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Readings of the converter for photo-electrons; for a frame that was read, its very codes.

        Args:
            electrons: Photo-electrons as in `Frames.electrons`.

        Examples:
            >>> Detector(DetectorSettings(preset="EMCCD")).to_adu(jnp.array([0.0, 7.0]))
            Array([408., 558.], dtype=...)
        """
        return self._convert(electrons * self.settings.em_gain)

    def to_electrons(self, adu: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """Photo-electrons of readings: bias removed, divided by the multiplication.

        Args:
            adu: Readings of the converter.

        Examples:
            >>> Detector(DetectorSettings(preset="EMCCD")).to_electrons(jnp.array([408.0, 558.0]))
            Array([0., 7.], dtype=...)
        """
        s = self.settings
        output = adu_to_electrons(adu, gain_electrons_per_adu=s.gain_electrons_per_adu, bias_adu=s.bias_adu)
        return output / s.em_gain

    def _convert(self, output_electrons: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        s = self.settings
        return electrons_to_adu(
            output_electrons,
            gain_electrons_per_adu=s.gain_electrons_per_adu,
            bias_adu=s.bias_adu,
            bits=s.bits,
        )
