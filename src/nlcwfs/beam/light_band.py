r"""Light of many wavelengths, and the few that stand for it.

A sum over wavelengths replaces the integral over a band. Gauss's nodes for the light at hand (Golub & Welsch 1969,
Math. Comp. 23, 221) integrate every polynomial in the wavelength up to degree 2 n - 1, whatever the light: flat, a
star's, or what a table says. How many are enough is in `beam.colour_sampling`.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.constants
import scipy.linalg
from astropy.table import Table
from jaxtyping import Float

from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.errors import FileFormatError, SettingsError

SMOOTH_NODES = 256
"""Points of a band without kinks; Gauss's nodes that are made of them are exact up to 256 wavelengths."""

NODES_OF_A_PIECE = 16
"""Points between two rows of a table, where the light is linear."""


@dataclass(frozen=True, eq=False)
class LightBand:
    """Light over a range of wavelengths, as points so dense that nothing is lost.

    Attributes:
        wavelengths_m: The points, ascending.
        shares: Share of the detected photons at each point; they sum to 1.
        ends_m: The shortest and the longest wavelength at which there is light.

    Examples:
        >>> band = LightBand.flat(wavelength_m=0.85e-6, bandwidth_m=0.34e-6)
        >>> [round(1e6 * one, 3) for one in band.spectrum(3).wavelengths_m]
        [0.718, 0.85, 0.982]
    """

    wavelengths_m: Float[np.ndarray, " point"]
    shares: Float[np.ndarray, " point"]
    ends_m: tuple[float, float]

    @classmethod
    def flat(cls, *, wavelength_m: float, bandwidth_m: float) -> "LightBand":
        """As many photons at every wavelength of a band.

        Raises:
            SettingsError: If a length is not positive, or the band reaches down to 0.
        """
        low_m, high_m = _ends(wavelength_m, bandwidth_m)
        return _from_pieces(np.array([low_m, high_m]), np.ones(2), SMOOTH_NODES)

    @classmethod
    def black_body(cls, *, wavelength_m: float, bandwidth_m: float, temperature_k: float) -> "LightBand":
        r"""The photons of a black body through a band: :math:`\lambda^{-4} / (\exp(hc / \lambda k T) - 1)` (Planck).

        Raises:
            SettingsError: If a length or the temperature is not positive, or the band reaches down to 0.

        Examples:
            >>> cool = LightBand.black_body(wavelength_m=0.85e-6, bandwidth_m=0.34e-6, temperature_k=3000.0)
            >>> bool(cool.shares @ cool.wavelengths_m > 0.855e-6)
            True
        """
        if not 0 < temperature_k < math.inf:
            raise SettingsError("beam.spectrum.temperature_k", "must be a positive temperature", temperature_k)
        low_m, high_m = _ends(wavelength_m, bandwidth_m)
        flat = _from_pieces(np.array([low_m, high_m]), np.ones(2), SMOOTH_NODES)
        hot_m = scipy.constants.h * scipy.constants.c / (scipy.constants.k * temperature_k)
        exponent = hot_m / flat.wavelengths_m
        # Relative to the longest wave, for which the exponential is smallest: a cold body must not underflow.
        log_photons = -4 * np.log(flat.wavelengths_m / high_m) - exponent - np.log(-np.expm1(-exponent))
        photons = flat.shares * np.exp(log_photons - log_photons.max())
        return cls(flat.wavelengths_m, photons / photons.sum(), flat.ends_m)

    @classmethod
    def tabulated(cls, wavelengths_m: Float[np.ndarray, " row"], photons: Float[np.ndarray, " row"]) -> "LightBand":
        """Photons per wavelength at some wavelengths, linear between them and none beyond.

        Raises:
            SettingsError: If there are fewer than two rows, wavelengths do not ascend, or photons are negative or none.

        Examples:
            >>> rows_um, photons = np.array([0.5, 0.6, 0.61, 0.79, 0.8, 0.9]), np.array([1, 1, 0, 0, 1, 1.0])
            >>> two = LightBand.tabulated(1e-6 * rows_um, photons)
            >>> [round(share, 2) for share in two.spectrum(2).shares]
            [0.5, 0.5]
        """
        where = "beam.spectrum.table"
        if len(wavelengths_m) < 2:
            raise SettingsError(where, "must have at least two rows", len(wavelengths_m))
        if not (np.all(np.isfinite(wavelengths_m)) and wavelengths_m[0] > 0 and np.all(np.diff(wavelengths_m) > 0)):
            raise SettingsError(where, "must have wavelengths that are positive and ascend", _few(wavelengths_m))
        if not np.all((photons >= 0) & np.isfinite(photons)):
            bad = photons[~((photons >= 0) & np.isfinite(photons))][0]
            raise SettingsError(where, "must have photons that are finite and not negative", f"{bad:g}")
        if not np.any(photons > 0):
            raise SettingsError(where, "must have photons at some wavelength", "zeros everywhere")
        return _from_pieces(wavelengths_m, photons, NODES_OF_A_PIECE)

    @property
    def most(self) -> int:
        """The largest number of wavelengths that can stand for this light."""
        return max(1, min(SMOOTH_NODES, int(np.count_nonzero(self.shares)) // 2))

    @property
    def effective_m(self) -> float:
        r"""Wavelength at which a path makes its mean phase: :math:`1 / \langle 1 / \lambda \rangle`.

        Examples:
            >>> band = LightBand.flat(wavelength_m=0.85e-6, bandwidth_m=0.34e-6)
            >>> round(1e6 * band.effective_m, 4), round(0.34 / math.log(1.02 / 0.68), 4)
            (0.8385, 0.8385)
        """
        return float(1 / (self.shares @ (1 / self.wavelengths_m)))

    def spectrum(self, count: int) -> Spectrum:
        """Gauss's nodes: the few wavelengths that stand for the light best, and their shares.

        Args:
            count: How many, at least 1.

        Raises:
            SettingsError: If the count is below 1, or above `most`.
        """
        if not 1 <= count <= self.most:
            raise SettingsError("beam.spectrum.wavelengths", f"must be from 1 to {self.most}", count)
        low_m, high_m = self.ends_m
        x = (2 * self.wavelengths_m - (low_m + high_m)) / (high_m - low_m) if high_m > low_m else 0 * self.shares
        diagonal, beside = np.zeros(count), np.zeros(max(count - 1, 0))
        before, now, norm = np.zeros_like(x), np.ones_like(x), 1.0
        for degree in range(count):  # Stieltjes's recursion: polynomials that are orthogonal under this light
            diagonal[degree] = self.shares @ (x * now**2)
            if degree + 1 < count:
                after = (x - diagonal[degree]) * now - (norm if degree else 0.0) * before
                norm = math.sqrt(self.shares @ after**2)
                before, now, beside[degree] = now, after / norm, norm
        nodes, vectors = scipy.linalg.eigh_tridiagonal(diagonal, beside)
        shares = vectors[0] ** 2
        wavelengths_m = (low_m + high_m) / 2 + (high_m - low_m) / 2 * nodes
        return Spectrum(tuple(wavelengths_m), tuple(shares / shares.sum()))

    def equal_steps(self, count: int) -> Spectrum:
        """The middles of equal steps in wavelength: what one would do without thinking; to compare.

        Examples:
            >>> band = LightBand.flat(wavelength_m=0.85e-6, bandwidth_m=0.34e-6)
            >>> [round(1e6 * one, 3) for one in band.equal_steps(2).wavelengths_m]
            [0.765, 0.935]
        """
        low_m, high_m = self.ends_m
        edges_m = np.linspace(low_m, high_m, count + 1)
        up_to = np.interp(edges_m, self.wavelengths_m, np.cumsum(self.shares) - self.shares / 2)
        up_to[0], up_to[-1] = 0.0, 1.0
        shares = np.diff(up_to)
        return Spectrum(tuple((edges_m[1:] + edges_m[:-1]) / 2), tuple(shares / shares.sum()))


def read_spectrum_table(path: Path | str) -> LightBand:
    r"""Read a text table of two columns, wavelength [um, or its unit] and photons per wavelength (ECSV, CSV).

    Args:
        path: The file; columns are taken in order, whatever their names.

    Raises:
        FileFormatError: If the file cannot be read, or has not two columns of numbers.
        SettingsError: If its numbers break a rule of `LightBand.tabulated`.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "filter.csv"
        >>> _ = path.write_text("wavelength_um,photons\n0.6,1\n0.7,3\n")
        >>> [round(1e6 * end, 3) for end in read_spectrum_table(path).ends_m]
        [0.6, 0.7]
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path}: must be readable as text, got {type(error).__name__}") from None
    kind = "ascii.ecsv" if text.startswith("# %ECSV") else "ascii.csv"
    try:
        table = Table.read(text.splitlines(), format=kind)
        if len(table.columns) != 2:
            raise FileFormatError(f"{path}: must have two columns, wavelength and photons, got {len(table.columns)}")
        first, second = table.columns[0], table.columns[1]
        micron = 1.0 if first.unit is None else first.unit.to("um")
        wavelengths_m, photons = np.asarray(first, float) * micron * 1e-6, np.asarray(second, float)
    except FileFormatError:
        raise
    except Exception as error:  # astropy has many of its own, and a sentence in each
        reason = str(error).strip().splitlines()[:1] or [type(error).__name__]
        raise FileFormatError(f"{path}: must be a table of two columns of numbers, got: {reason[0][:100]}") from None
    return LightBand.tabulated(wavelengths_m, photons)


def _ends(wavelength_m: float, bandwidth_m: float) -> tuple[float, float]:
    if not 0 < wavelength_m < math.inf:
        raise SettingsError("beam.wavelength_um", "must be a positive length", wavelength_m * 1e6)
    if not 0 < bandwidth_m < 2 * wavelength_m:
        rule = f"must be positive and less than {2e6 * wavelength_m:g}, at which the band reaches down to 0"
        raise SettingsError("beam.spectrum.bandwidth_um", rule, f"{bandwidth_m * 1e6:g}")
    return wavelength_m - bandwidth_m / 2, wavelength_m + bandwidth_m / 2


def _from_pieces(edges_m: Float[np.ndarray, " row"], photons: Float[np.ndarray, " row"], points: int) -> LightBand:
    """Points of Gauss and Legendre in every piece, weighted by light that is linear in it."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    along = (nodes + 1) / 2
    wide_m = np.diff(edges_m)[:, None]
    wavelengths_m = edges_m[:-1, None] + wide_m * along
    light = (photons[:-1, None] * (1 - along) + photons[1:, None] * along) * weights * wide_m
    lit = np.flatnonzero(light.any(axis=1))
    ends_m = float(edges_m[lit[0]]), float(edges_m[lit[-1] + 1])
    return LightBand(wavelengths_m.ravel(), (light / light.sum()).ravel(), ends_m)


def _few(values: Float[np.ndarray, " row"]) -> str:
    step = int(np.argmax(~(np.diff(values, prepend=0) > 0)))
    return f"{values[step] * 1e6:g} um in row {step + 1}"
