r"""What dispersion, the size of the star and its scintillation cost the wavefront of one exposure: closed forms.

Light from many directions smears the images: a wave of frequency f at z keeps :math:`V(z f)` of itself. What that costs
is told for the ripples of a weak wavefront, each with the signal :math:`2 \sin(\pi \lambda z f^2)` per radian. Study 14
compares it with reconstructions, of weak wavefronts and of rough ones.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Complex, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.atmosphere.scintillation import amplitude_variance
from nlcwfs.simulation.colours import Colours

FREQUENCIES = 1600
AZIMUTHS = 33


@dataclass(frozen=True)
class SkyBudget:
    """One exposure of a sensor with symmetric planes of equal light, behind a wavefront of Kolmogorov's spectrum.

    Attributes:
        air: The wavefront.
        colours: The light: wavelengths, planes, directions and the size of the star.
        wavelength_m: Of sensing.
        diameter_m: Of the telescope.
        pixel_m: Of the detector, at the scale of the telescope.
        photons: Of the exposure.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> from nlcwfs.simulation.colours import colours_of
        >>> air = Turbulence.from_rms(opd_rms_m=100e-9, diameter_m=8.0)
        >>> colours = colours_of(load_config(None, ["atmosphere.star.size_mas=30"]), air)
        >>> light = {"wavelength_m": 0.85e-6, "diameter_m": 8.0, "pixel_m": 0.18, "photons": 2e6}
        >>> budget = SkyBudget(air, colours, **light)
        >>> [round(1e9 * budget.smeared_m(knows=knows), 1) for knows in (False, True)]
        [2.3, 1.8]
    """

    air: Turbulence
    colours: Colours
    wavelength_m: float
    diameter_m: float
    pixel_m: float
    photons: float

    def smeared_m(self, *, knows: bool) -> float:
        r"""Error that smeared ripples add in quadrature.

        A mode of variance :math:`C`, of which N photons hold the information :math:`F = 4 N \langle s^2 \rangle`,
        :math:`s = \sin(\pi \lambda z f^2)`, is known to :math:`C / (1 + F C)`. A model that knows the smear loses
        information, :math:`F = 4 N \langle s^2 V^2 \rangle`. One that does not believes :math:`w = F C / (1 + F C)` of
        waves that are too faint, and errs by :math:`C |1 - w V|^2 + w^2 / F`, V weighted with :math:`s^2`; and by the
        mean direction of the light as a tilt.
        """
        frequency, variance, modes = self._modes()
        planes_m = self._planes_m()
        signal = np.sin(np.pi * self.wavelength_m * planes_m[:, None] * frequency**2) ** 2
        seen = 4 * self.photons * np.mean(signal, axis=0)
        left = self._fading(planes_m[:, None] * frequency, planes_m)
        if knows:
            told = 4 * self.photons * np.mean(signal[..., None] * np.abs(left) ** 2, axis=0)
            error = np.mean(variance[:, None] / (1 + told * variance[:, None]), axis=1)
        else:
            believed = seen * variance / (1 + seen * variance)
            faint = np.mean(signal[..., None] * left, axis=0) / np.mean(signal, axis=0)[:, None]
            short = np.mean(np.abs(1 - believed[:, None] * faint) ** 2, axis=1)
            error = variance * short + believed * variance / (1 + seen * variance)
        return self._in_metres(modes * (error - variance / (1 + seen * variance)), tilted=not knows)

    def twinkling_m(self, whole: Turbulence, heights_m: tuple[float, ...], fractions: tuple[float, ...]) -> float:
        r"""Error that an amplitude which the model does not know adds in quadrature, behind a rough wavefront.

        Signals of the amplitude's logarithm are as strong as those of the phase, and in speckles unlike them: as many
        numbers as M planes have measure the phase, and :math:`\langle \chi^2 \rangle / M` of the waves that pixels show
        is taken for it. Ripples of a weak wavefront are told from the amplitude's by pairs of planes at plus and minus
        z, to first order without an error.
        """
        layers = {"heights_m": heights_m, "fractions": fractions, "wavelength_m": self.wavelength_m}
        seen = amplitude_variance(whole, **layers, finest_per_m=1 / (2 * self.pixel_m))
        return self.wavelength_m / (2 * np.pi) * math.sqrt(seen / len(self._planes_m()))

    @property
    def tilt_m(self) -> float:
        """Rms of the tilt for which light from the mean direction of the colours is taken: angle times D / 4."""
        planes_m = self._planes_m()
        mean = np.mean(self._mean_direction(planes_m), axis=0)
        return float(np.hypot(*mean)) * self.diameter_m / 4

    @property
    def dispersion_rad(self) -> float:
        """Rms over the photons of the colours' directions, about their mean."""
        directions = np.array(self.colours.star.directions_rad)
        if not len(directions):
            return 0.0
        shares = np.array(self.colours.spectrum.shares)
        centred = directions - shares @ directions
        return math.sqrt(float(shares @ np.sum(centred**2, axis=1)))

    def _modes(self) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, " f"], Float[np.ndarray, " f"]]:
        """Frequencies, variance [rad^2] of a mode of rms 1, and how many modes each stands for, in what pixels hold."""
        frequency = np.geomspace(0.5 / self.diameter_m, 1 / self.pixel_m, FREQUENCIES)
        angle = np.pi * self.diameter_m * frequency
        area = math.pi / 4 * self.diameter_m**2
        per_m = 2 * np.pi / self.wavelength_m
        without_piston = 1 - (2 * scipy.special.j1(angle) / angle) ** 2
        variance = per_m**2 * self.air.opd_spectrum(frequency) * without_piston / area
        held = np.sinc(frequency * self.pixel_m / math.sqrt(2)) ** 4  # a square pixel, along its diagonal
        return frequency, variance, area * 2 * np.pi * frequency * np.gradient(frequency) * held

    def _planes_m(self) -> Float[np.ndarray, " plane"]:
        """Signed distance of each plane at the wavelength of sensing."""
        first_m = self.colours.spectrum.wavelengths_m[:1]
        return np.asarray(self.colours.distances_m[0]) / self.colours.law.scale(first_m)[0]

    def _fading(
        self, cycles_per_rad: Float[np.ndarray, "plane f"], planes_m: Float[np.ndarray, " plane"]
    ) -> Complex[np.ndarray, "plane f azimuth"]:
        """What is left of waves, in each direction; that all are moved alike is not counted."""
        colours, turn = self.colours, np.linspace(0, np.pi, AZIMUTHS, endpoint=False)
        means = self._mean_direction(planes_m)
        along = np.stack([np.sin(turn), np.cos(turn)])
        directions = colours.star.directions_rad or ((0.0, 0.0),) * len(colours.spectrum.shares)
        total = np.zeros((*cycles_per_rad.shape, AZIMUTHS), complex)
        for share, row_m, direction in zip(colours.spectrum.shares, colours.distances_m, directions, strict=True):
            scale = row_m / planes_m
            moved = (scale[:, None] * np.array(direction) - means) @ along
            phase = np.exp(-2j * np.pi * cycles_per_rad[:, :, None] * moved[:, None, :])
            total += share * colours.star.fading(scale[:, None] * np.abs(cycles_per_rad))[:, :, None] * phase
        return total

    def _mean_direction(self, planes_m: Float[np.ndarray, " plane"]) -> Float[np.ndarray, "plane 2"]:
        """By how much the light of each plane is moved, over its distance."""
        colours = self.colours
        if not colours.star.directions_rad:
            return np.zeros((len(planes_m), 2))
        scale = colours.distances_m / planes_m
        return np.einsum("c,cp,cd->pd", np.array(colours.spectrum.shares), scale, np.array(colours.star.directions_rad))

    def _in_metres(self, error_rad2: Float[np.ndarray, " f"], *, tilted: bool) -> float:
        """The root of what is added, and a tilt."""
        added = float(np.sum(error_rad2)) * (self.wavelength_m / (2 * np.pi)) ** 2
        return math.sqrt(max(added, 0.0) + (self.tilt_m**2 if tilted else 0.0))
