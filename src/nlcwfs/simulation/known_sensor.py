"""What a reconstructor is told of the simulated sensor."""

import numpy as np
from jaxtyping import Float

from nlcwfs.beam.pupil import nearest_lit
from nlcwfs.config import Config
from nlcwfs.curvature_sensor.apparent_star import POINT
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.simulation.colours import band_of, colours_of, lens_law
from nlcwfs.simulation.exposure import ExposureSimulator, distances_m, wavelength_m


def geometry_of(config: Config, simulator: ExposureSimulator) -> SensorGeometry:
    """What the reconstructor knows: a static aberration; colours, the star and a membrane's motion if it is told."""
    count, colours = config.estimation.map.wavelengths, None
    knows_star = config.estimation.map.star == "told" and config.atmosphere.star.size_mas > 0
    if knows_star or (count > 1 and config.beam.spectrum.shape != "line"):
        spectrum = config.beam.spectrum.model_copy(update={"wavelengths": count})
        beam = config.beam.model_copy(update={"spectrum": spectrum})
        still = {"membrane": "none", "membrane_dead_share": 0.0}  # what moves is said below
        planes = config.curvature_sensor.model_copy(update=still)
        colours = colours_of(config.model_copy(update={"beam": beam, "curvature_sensor": planes}), simulator.air)
    sensor = config.curvature_sensor
    geometry = SensorGeometry(
        pupil=simulator.shape,
        frame=simulator.frame,
        wavelength_m=wavelength_m(config),
        distances_m=distances_m(config),
        flux_fractions=sensor.flux_fractions,
        static_opd_m=_static_m(simulator) if sensor.static_rms_nm else None,
        static_grid=simulator.light,
        spectrum=colours and colours.spectrum,
        colour_distances_m=colours and tuple(tuple(map(float, one)) for one in colours.distances_m),
        star=colours.star if colours else POINT,
        motion=sensor.membrane,
        moments=config.estimation.map.membrane_moments,
        dead_share=sensor.membrane_dead_share,
    )
    band = band_of(config) if colours is None else None
    return geometry if band is None else geometry.in_mean_phase(band, lens_law(config))


def _static_m(simulator: ExposureSimulator) -> Float[np.ndarray, "Y X"]:
    """The aberration in the arm, beyond the rim as it is there."""
    lit = np.asarray(simulator.weights) > 0
    return np.asarray(simulator.sensor.static_opd_m, float)[lit][nearest_lit(lit)]
