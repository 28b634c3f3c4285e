"""The search for the planes: coarse distances, then finer ones around the best, then the split of the light."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.optimize

from nlcwfs.simulation.design.loop_errors import Planes, loop_errors
from nlcwfs.simulation.design.plane_information import PlaneInformation

COARSE = (0.125, 0.25, 0.45, 0.67, 1.0, 1.5, 2.3, 3.5)
"""Distances that are tried first, over D^2 / (2 c lambda) for a mirror of c cycles per aperture, at which light of its
finest wave has left the axis by D / 2: 0.3 to 8.2 thousand km for 8 m at 0.85 um and 16 cycles."""

FINER = (1.25, 1.1)
"""Factors by which distances are then moved to and fro."""

LEAST_RATIO = 1.15
"""Of the distances of two pairs: nearer to each other they tell the same."""

Tell = Callable[[str], None]


def search_planes(
    information: PlaneInformation, *, pairs: int, rate_hz: float, tell: Tell = lambda line: None
) -> Planes:
    """Symmetric pairs that leave the least error of the mirror's modes.

    Args:
        information: Of planes on pixels.
        pairs: One or two.
        rate_hz: Exposures in a second.
        tell: Called with what is being done.

    Examples:
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> from nlcwfs.simulation.design.loop_residual import Loop
        >>> small = Loop(Turbulence(0.2), 1.0, 0.85e-6, 4.0, 10.0, 1.0, photons_per_s=1e6)
        >>> from nlcwfs.simulation.design.loop_residual import LoopResidual
        >>> from nlcwfs.simulation.design.plane_information import Pixels
        >>> left = LoopResidual.build(small, PupilShape(1.0)).redrawn(rate_hz=500.0, draws=1, seed=0)
        >>> found = search_planes(PlaneInformation(left, Pixels(12, 18)), pairs=1, rate_hz=500.0)
        >>> 70 < found.distances_m[0] / 1e3 < 300, found.shares  # D^2 / (2 c lambda) is 147 km
        (True, (1.0,))
    """
    loop = information.residual.loop
    unit_m = loop.diameter_m**2 / (2 * loop.cutoff_cpa * loop.wavelength_m)

    def left_m(distances_m: Sequence[float]) -> float:
        return loop_errors(information, Planes.evenly(*distances_m), rate_hz=rate_hz).photon_m

    coarse_m = [_rounded(share * unit_m) for share in COARSE]
    for number, distance_m in enumerate(coarse_m):
        tell(f"planes at {distance_m / 1e3:.0f} km, {number + 1} of {len(coarse_m)}")
        information.of_pair(distance_m)
    best = min((one for one in itertools.combinations(coarse_m, pairs) if _apart(one)), key=left_m)
    for factor in FINER:
        tell(f"planes near {' and '.join(f'{one / 1e3:.0f}' for one in best)} km")
        around = [[_rounded(one / factor), one, _rounded(one * factor)] for one in best]
        candidates = [tuple(one) for one in itertools.product(*around) if _apart(one)]
        best = min(candidates, key=left_m)
    best = tuple(sorted(best))
    return Planes(best, _split(information, best, rate_hz)) if pairs == 2 else Planes.evenly(*best)


def _apart(distances_m: Sequence[float]) -> bool:
    ordered = sorted(distances_m)
    return all(far >= LEAST_RATIO * near for near, far in itertools.pairwise(ordered))


def _rounded(distance_m: float) -> float:
    """Two digits and a half: nobody places a detector better, and a design is easier to read."""
    step = 10 ** math.floor(math.log10(distance_m)) / 20
    return round(distance_m / step) * step


def _split(information: PlaneInformation, distances_m: tuple[float, ...], rate_hz: float) -> tuple[float, ...]:
    """Shares of the light of two pairs, between a tenth and nine tenths."""

    def left_m(near: float) -> float:
        return loop_errors(information, Planes(distances_m, (near, 1 - near)), rate_hz=rate_hz).photon_m

    near = round(float(np.ravel(scipy.optimize.fminbound(left_m, 0.1, 0.9, xtol=0.02))[0]), 2)
    return near, round(1 - near, 2)
