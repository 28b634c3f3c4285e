"""The rivals of the curvature sensor, as good as their experts make them.

Enters: the optical path difference at the pupil. Leaves: the photons on their detectors. Equations, Shack-Hartmann:
`photons[spot] = |Fourier transform of the field in the subaperture|^2` inside the field of view of its lenslet;
pyramid: `photons = |roof_y @ field @ roof_x^T|^2`, summed over the circle of the modulation.
"""

from nlcwfs.comparison_sensors.pyramid import PupilImages, Pyramid
from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann, Spots, lenslet_grid

__all__ = ["PupilImages", "Pyramid", "ShackHartmann", "Spots", "lenslet_grid"]
