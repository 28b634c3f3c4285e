"""A loop that closes within seconds: 2 m, 16 pixels, planes scaled with the square of the diameter."""

from nlcwfs.config import Config, load_config

SMALL = [
    "atmosphere.seeing_arcsec=0.6",
    "atmosphere.photons_per_s=2e6",
    "beam.diameter_m=2",
    "beam.wavelength_um=0.85",
    "curvature_sensor.distances_km=[-219, -156, 156, 219]",
    "detector.pixels_across_pupil=16",
    "detector.window_pixels=24",
    "estimation.modes=60",
    "estimation.seeing_arcsec=0.6",
    "loop.rate_hz=500",
    "loop.seconds=0.12",
    "loop.settle_s=0.01",
    "mirror.cutoff_cpa=5",
    "simulation.light_window=1.5",
]


def small(*overrides: str) -> Config:
    return load_config(None, [*SMALL, *overrides])
