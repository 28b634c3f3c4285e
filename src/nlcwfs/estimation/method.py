"""The reconstructor that the settings ask for."""

from nlcwfs.beam.modes import ModalBasis
from nlcwfs.estimation.expected_amplitude import refuse_estimated
from nlcwfs.estimation.linear_reconstructor import LinearReconstructor
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.reconstructor import GerchbergSaxton
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings

Reconstructor = GerchbergSaxton | LinearReconstructor | MaximumAPosteriori
"""All have `estimate(counts, usable, read_variance=..., start_m=...) -> WavefrontEstimate`."""


def build_reconstructor(
    geometry: SensorGeometry, settings: EstimationSettings, *, basis: ModalBasis | None = None, dtype: str = "float32"
) -> Reconstructor:
    """Prepare the method of the settings for a sensor.

    Args:
        geometry: The sensor.
        settings: Method and options.
        basis: Modes on the frames' pixels, for `gerchberg-saxton` with `unwrapping = "slopes"`.
        dtype: Precision.

    Raises:
        SettingsError: If an option contradicts another.
        SamplingError: If the pupil does not fit on the frames.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((32, 32), 0.36), 0.65e-6, (-3e6, 3e6))
        >>> type(build_reconstructor(geometry, EstimationSettings(method="gerchberg-saxton"))).__name__
        'GerchbergSaxton'
    """
    if settings.method == "map":
        return MaximumAPosteriori.build(geometry, settings, dtype=dtype)
    refuse_estimated(settings, because=f"estimation.method = {settings.method}")
    if settings.method == "linear":
        return LinearReconstructor.build(geometry, settings, linear=settings.linear, dtype=dtype)
    return GerchbergSaxton.build(geometry, settings, basis=basis, dtype=dtype)
