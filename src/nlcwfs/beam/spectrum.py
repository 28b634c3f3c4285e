"""The colours of the light: wavelengths and the share of the photons that each carries."""

from dataclasses import dataclass

import numpy as np

from nlcwfs.errors import SettingsError


@dataclass(frozen=True)
class Spectrum:
    """Wavelengths and their shares of the photons.

    Attributes:
        wavelengths_m: Sampled wavelengths.
        shares: Fraction of the photons at each wavelength; they sum to 1.

    Raises:
        SettingsError: If there is no wavelength, one is not positive, or the shares do not sum to 1.

    Examples:
        >>> Spectrum.monochromatic(0.65e-6)
        Spectrum(wavelengths_m=(6.5e-07,), shares=(1.0,))
    """

    wavelengths_m: tuple[float, ...]
    shares: tuple[float, ...]

    def __post_init__(self) -> None:
        # Python's numbers take the precision of the light; NumPy's would impose theirs.
        object.__setattr__(self, "wavelengths_m", tuple(map(float, self.wavelengths_m)))
        object.__setattr__(self, "shares", tuple(map(float, self.shares)))
        if not self.wavelengths_m or not all(0 < wavelength < np.inf for wavelength in self.wavelengths_m):
            raise SettingsError("spectrum.wavelengths_m", "must be positive lengths", self.wavelengths_m)
        if len(self.shares) != len(self.wavelengths_m):
            raise SettingsError("spectrum.shares", "must be one per wavelength", self.shares)
        if min(self.shares) < 0 or not np.isclose(sum(self.shares), 1.0, atol=1e-9):
            raise SettingsError("spectrum.shares", "must be positive and sum to 1", self.shares)

    @classmethod
    def monochromatic(cls, wavelength_m: float) -> "Spectrum":
        """Light of one wavelength."""
        return cls((wavelength_m,), (1.0,))
