"""What the astronomer gets: the image of the star, and how good it is.

Enters: the residual optical path difference. Leaves: point-spread functions and Strehl ratios. Equation:
`psf = |Fraunhofer(pupil * exp(2 pi i opd / wavelength))|^2`. Beside it, the halo of a fast loop in closed form.
"""
