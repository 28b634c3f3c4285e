"""The rivals of the curvature sensor, as good as their experts make them.

Enters: the optical path difference at the pupil. Leaves: the photons on their detectors. Shack-Hartmann, equation:
`photons[spot] = |Fourier transform of the field in the subaperture|^2` inside the field of view of its lenslet.
"""

from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann, Spots, lenslet_grid

__all__ = ["ShackHartmann", "Spots", "lenslet_grid"]
