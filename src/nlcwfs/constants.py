"""Numbers of physics and units, each with its source."""

import math

ARCSEC_RAD = math.pi / 180 / 3600
"""One second of arc in radians, by definition."""

SEEING_TO_FRIED = 0.976
"""FWHM of the long exposure = 0.976 lambda / r0 (Kolmogorov; Tokovinin 2002, PASP 114, 1156, eq. 5)."""

SEEING_WAVELENGTH_M = 0.5e-6
"""Wavelength at which seeing is quoted, by the field's convention."""
