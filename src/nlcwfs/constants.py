"""Numbers of physics and units, each with its source."""

import math

ARCSEC_RAD = math.pi / 180 / 3600
"""One second of arc in radians, by definition."""

SEEING_TO_FRIED = 0.976
"""FWHM of the long exposure = 0.976 lambda / r0 (Kolmogorov; Tokovinin 2002, PASP 114, 1156, eq. 5)."""

SEEING_WAVELENGTH_M = 0.5e-6
"""Wavelength at which seeing is quoted, by the field's convention."""

KOLMOGOROV_STRUCTURE = 2 * (24 / 5 * math.gamma(6 / 5)) ** (5 / 6)
"""D(r) = 6.88 (r / r0)^(5/3) [rad^2] (Fried 1965; Roddier 1981, Progress in Optics 19, 281)."""
