"""What a reconstructor is told of the simulated sensor."""

from nlcwfs.config import Config
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.simulation.exposure import ExposureSimulator, distances_m, wavelength_m


def geometry_of(config: Config, simulator: ExposureSimulator) -> SensorGeometry:
    """What the reconstructor knows of the sensor."""
    return SensorGeometry(
        pupil=simulator.shape,
        frame=simulator.frame,
        wavelength_m=wavelength_m(config),
        distances_m=distances_m(config),
        flux_fractions=config.curvature_sensor.flux_fractions,
    )
