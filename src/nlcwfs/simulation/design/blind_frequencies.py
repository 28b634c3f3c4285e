r"""Waves that a set of planes does not show on a flat wavefront.

A weak ripple of frequency f becomes contrast :math:`2 \sin(\pi \lambda z f^2)` at the distance z (Guyon 2010, eq. 2):
none at :math:`f = \sqrt{n / (\lambda |z|)}`. Planes together are blind where all of them are.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from nlcwfs.errors import SettingsError

FAINT = 0.05
r"""Signal below which a wave counts as not shown, over the largest, :math:`\sqrt{\sum w \sin^2}`: one in 400 of the
photons tell of it."""


def flat_signal(
    cycles_per_aperture: Float[np.ndarray, "*shape"],
    distances_m: Sequence[float],
    *,
    wavelength_m: float,
    diameter_m: float,
) -> Float[np.ndarray, "*shape"]:
    r"""Signal of waves on a flat wavefront, over the largest: root mean square of :math:`\sin(\pi \lambda z f^2)`.

    Args:
        cycles_per_aperture: Frequencies of the waves, cycles per telescope diameter.
        distances_m: Of the planes, which share the light equally.
        wavelength_m: Of the light.
        diameter_m: Of the telescope.

    Examples:
        >>> waves = {"wavelength_m": 0.85e-6, "diameter_m": 8.0}
        >>> flat_signal(np.array([2.0, 12.27]), [2.5e6, 3.5e6], **waves).round(2).tolist()
        [0.48, 0.0]
    """
    squared = (np.asarray(cycles_per_aperture, float) / diameter_m) ** 2
    sines = [np.sin(np.pi * wavelength_m * distance_m * squared) for distance_m in distances_m]
    return np.sqrt(np.mean(np.square(sines), axis=0))


def blind_frequencies(
    distances_m: Sequence[float], *, wavelength_m: float, diameter_m: float, up_to: float
) -> list[float]:
    """Frequencies above zero at which no plane shows a ripple on a flat wavefront, cycles per aperture.

    Args:
        distances_m: Of the planes; one of each symmetric pair is enough.
        wavelength_m: Of the light.
        diameter_m: Of the telescope.
        up_to: Highest frequency that matters, cycles per aperture.

    Raises:
        SettingsError: If there is no plane out of the pupil.

    Examples:
        >>> waves = {"wavelength_m": 0.85e-6, "diameter_m": 8.0, "up_to": 16.0}
        >>> [round(one, 2) for one in blind_frequencies([-3.5e6, -2.5e6, 2.5e6, 3.5e6], **waves)]
        [12.27]
        >>> blind_frequencies([-3.5e6, -3e5, 3e5, 3.5e6], **waves)
        []
    """
    away_m = [abs(distance_m) for distance_m in distances_m if distance_m]
    if not away_m:
        raise SettingsError("curvature_sensor.distances_km", "must hold a plane out of the pupil", tuple(distances_m))
    # The nearest plane has the fewest: all others must be blind there, too.
    nearest_m = min(away_m)
    orders = np.arange(1, int(wavelength_m * nearest_m * (up_to / diameter_m) ** 2) + 1)
    cycles = diameter_m * np.sqrt(orders / (wavelength_m * nearest_m))
    signal = flat_signal(cycles, away_m, wavelength_m=wavelength_m, diameter_m=diameter_m)
    return [float(one) for one in cycles[signal < FAINT]]
