"""Complex light at the pupil, and how it travels.

Enters: an optical path difference `opd_m[y x]` and the amplitude of the pupil. Leaves: the complex field
`sqrt(photons per pixel)` on a `Grid`, here or at a distance.

Equations: `field = A exp(+2 pi i opd / wavelength)`; Fresnel travel multiplies the spectrum by
`exp(-i pi wavelength z |f|^2)` (Goodman 2005, sec. 4.2, without the carrier); Fraunhofer travel is a Fourier
transform to angles.
"""
