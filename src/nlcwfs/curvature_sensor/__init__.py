"""The defocused pupil images.

Enters: the optical path difference at the pupil. Leaves: `Planes`, the photons that fall on each defocused image
per grid pixel. Equation: `photons[plane] = flux_fraction[plane] * |propagate_fresnel(pupil_field, z[plane])|^2`,
summed over the colours of the light.
"""

from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor, Planes

__all__ = ["CurvatureSensor", "Planes"]
