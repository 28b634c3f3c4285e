"""What a reconstructor is told of the simulated sensor."""

import numpy as np
from jaxtyping import Float

from nlcwfs.beam.pupil import nearest_lit
from nlcwfs.config import Config
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.simulation.exposure import ExposureSimulator, distances_m, wavelength_m


def geometry_of(config: Config, simulator: ExposureSimulator) -> SensorGeometry:
    """What the reconstructor knows of the sensor, a static aberration included."""
    return SensorGeometry(
        pupil=simulator.shape,
        frame=simulator.frame,
        wavelength_m=wavelength_m(config),
        distances_m=distances_m(config),
        flux_fractions=config.curvature_sensor.flux_fractions,
        static_opd_m=_static_m(simulator) if config.curvature_sensor.static_rms_nm else None,
        static_grid=simulator.light,
    )


def _static_m(simulator: ExposureSimulator) -> Float[np.ndarray, "Y X"]:
    """The aberration in the arm, beyond the rim as it is there."""
    lit = np.asarray(simulator.weights) > 0
    return np.asarray(simulator.sensor.static_opd_m, float)[lit][nearest_lit(lit)]
