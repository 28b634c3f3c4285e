"""The sensor of a loop in the words of the AO telemetry standard (AOT)."""

import aotpy
import numpy as np

from nlcwfs.simulation.closed_loop.lenslet_light import LensletOptics
from nlcwfs.simulation.closed_loop.loop import Loop
from nlcwfs.simulation.closed_loop.pyramid_light import PyramidOptics


def aot_sensor(
    loop: Loop, star: aotpy.NaturalGuideStar, detector: aotpy.Detector, measured: aotpy.Image
) -> aotpy.ShackHartmann | aotpy.Pyramid:
    """A sensor with what it measured, modes of the mirror instead of slopes."""
    optics = loop.light.optics
    common = {"source": star, "detector": detector, "wavelength": loop.config.beam.wavelength_um * 1e-6}
    if isinstance(optics, LensletOptics):
        lattice = optics.sensor.active
        number = np.where(lattice, np.cumsum(lattice).reshape(lattice.shape) - 1, -1)  # -1: does not serve
        return aotpy.ShackHartmann(
            "sensor",
            n_valid_subapertures=optics.sensor.count,
            subaperture_mask=aotpy.Image("subaperture mask", number),
            subaperture_size=optics.sensor.subaperture_m,
            centroiding_algorithm=loop.config.shack_hartmann.centroid,
            **common,
        )
    if isinstance(optics, PyramidOptics):
        modes, circle = measured.data.shape[2], loop.config.pyramid.modulation_lambda_over_d
        return aotpy.Pyramid(
            "sensor",
            n_sides=4,
            dimensions=1,
            measurements=measured,
            n_valid_subapertures=modes,
            modulation=circle * common["wavelength"],  # path from rim to rim
            **common,
        )
    # the standard knows no curvature sensor; pupil images side by side come nearest
    sides, modes = loop.light.still.sensor.transfer.shape[1], measured.data.shape[2]
    return aotpy.Pyramid(
        "sensor", n_sides=sides, dimensions=1, measurements=measured, n_valid_subapertures=modes, **common
    )
