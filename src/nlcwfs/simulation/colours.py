"""Light of many colours on its way through one sensor: which wavelengths, which planes, from which directions."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.atmosphere.refraction import residual_dispersion_rad
from nlcwfs.beam.colour_sampling import ColouredImage, sampling_error, step_coherence, wavelengths_needed
from nlcwfs.beam.light_band import LightBand, read_spectrum_table
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.config import Config
from nlcwfs.constants import ARCSEC_RAD
from nlcwfs.curvature_sensor.apparent_star import POINT, ApparentStar
from nlcwfs.curvature_sensor.chromatic_lenses import LensLaw
from nlcwfs.curvature_sensor.membrane import (
    Moments,
    membrane_moments,
    moments_needed,
    moments_of_model,
    moving_light,
)
from nlcwfs.errors import SettingsError

TILTED_TO_FLAT = math.sqrt(1.0299 / 0.134)
"""Rms of Kolmogorov turbulence over a disc, tilt included, over that without tilt (Noll 1976, table IV)."""


@dataclass(frozen=True, eq=False)
class Colours:
    """What the sensor must know of the light's colours.

    Attributes:
        spectrum: Wavelengths and their shares of the detected photons.
        distances_m: Where each plane is in each colour.
        star: Where each colour comes from, and how large the star is.
        law: The lenses.
        error: Expected error of the images because wavelengths are few, of their fluctuations, rms.
    """

    spectrum: Spectrum
    distances_m: Float[np.ndarray, "colour plane"]
    star: ApparentStar
    law: LensLaw
    error: float

    def in_motion(self, moments: Moments) -> "Colours":
        """The same behind a membrane: each colour once for every moment."""
        spectrum, moved_m, star = moving_light(self.spectrum, self.distances_m, self.star, moments)
        return dataclasses.replace(self, spectrum=spectrum, distances_m=moved_m, star=star)


def band_of(config: Config) -> LightBand | None:
    """The light of a configuration; None for light of one wavelength.

    Raises:
        SettingsError: If a table is none, the band is as wide as its wavelength, or it is all on one side of it.
        FileFormatError: If a table cannot be read.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> flat = band_of(load_config(None, ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_um=0.1"]))
        >>> [round(1e6 * end, 2) for end in flat.ends_m], band_of(Config())
        ([0.8, 0.9], None)
    """
    settings, wavelength_m = config.beam.spectrum, config.beam.wavelength_um * 1e-6
    if settings.shape == "line":
        return None
    where = "beam.spectrum.table"
    if settings.shape == "table":
        band = read_spectrum_table(str(settings.table))
    else:
        where = "beam.spectrum.bandwidth_um" if settings.bandwidth_um is not None else "beam.spectrum.bandwidth_ratio"
        width = {"bandwidth_m": settings.bandwidth_um_at(config.beam.wavelength_um) * 1e-6}
        if settings.shape == "flat":
            band = LightBand.flat(wavelength_m=wavelength_m, **width)
        else:
            band = LightBand.black_body(wavelength_m=wavelength_m, temperature_k=settings.temperature_k, **width)
    low_m, high_m = band.ends_m
    shown = f"{low_m * 1e6:.4g} to {high_m * 1e6:.4g} um"
    if high_m - low_m >= wavelength_m:
        raise SettingsError(where, f"must be narrower than beam.wavelength_um, {wavelength_m * 1e6:g} um", shown)
    if not low_m < wavelength_m < high_m:
        rule = f"must have light on both sides of beam.wavelength_um, {wavelength_m * 1e6:g} um"
        raise SettingsError(where, rule, shown)
    return band


def bandwidth_m(config: Config) -> float:
    """Width of the light, from its shortest to its longest wavelength; 0 for one wavelength.

    Examples:
        >>> bandwidth_m(Config())
        0.0
    """
    settings = config.beam.spectrum
    if settings.shape in ("flat", "black-body"):
        return settings.bandwidth_um_at(config.beam.wavelength_um) * 1e-6
    band = band_of(config)
    return 0.0 if band is None else band.ends_m[1] - band.ends_m[0]


def colours_of(config: Config, air: Turbulence) -> Colours:
    """Choose the wavelengths, and find for each where its planes are and where it comes from.

    As many wavelengths are taken as the images of the whole turbulence need, see `beam.colour_sampling`, unless the
    user says how many.

    Raises:
        SettingsError: If lenses, air or detector cannot serve the band.
        FileFormatError: If a table cannot be read.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> air = Turbulence.from_seeing(seeing_arcsec=0.6)
        >>> flat = ["beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.4", "curvature_sensor.lenses=ideal"]
        >>> colours = colours_of(load_config(None, flat), air)
        >>> len(colours.spectrum.shares), colours.error < 0.03
        (10, True)
    """
    band, wavelength_m = band_of(config), config.beam.wavelength_um * 1e-6
    law = lens_law(config)
    planes_m = [distance_km * 1e3 for distance_km in config.curvature_sensor.distances_km]
    size = {"size_rad": config.atmosphere.star.size_mas * 1e-3 * ARCSEC_RAD, "profile": config.atmosphere.star.profile}
    if band is None:
        one = Spectrum.monochromatic(wavelength_m)
        star = ApparentStar(**size) if size["size_rad"] else POINT
        return Colours(one, law.distances_m(planes_m, one.wavelengths_m), star, law, 0.0).in_motion(_moments(config))
    images = _images(config, air, law)
    count = config.beam.spectrum.wavelengths or wavelengths_needed(images, band)
    spectrum = band.spectrum(count)
    directions = _directions_rad(config, spectrum.wavelengths_m)
    error = max(sampling_error(image, band, spectrum) for image in images)
    star = ApparentStar(tuple(directions), **size)
    places_m = law.distances_m(planes_m, spectrum.wavelengths_m)
    return Colours(spectrum, places_m, star, law, error).in_motion(_moments(config))


def colour_account(config: Config, air: Turbulence) -> list[str]:
    """What the colours and the size of the star are, a line for each thing that a user may want to know.

    Examples:
        >>> colour_account(Config(), Turbulence.from_seeing(seeing_arcsec=0.6))
        []
    """
    lines, star = [], config.atmosphere.star
    if config.beam.spectrum.shape != "line":
        colours = colours_of(config, air)
        band, count = band_of(config), len(set(colours.spectrum.wavelengths_m))
        low_m, high_m = colours.spectrum.wavelengths_m[:1] * 2 if band is None else band.ends_m
        enough = f"images right to {colours.error:.2g} of their fluctuations, about"
        lines.append(
            f"Colours: {config.beam.spectrum.shape}, {low_m * 1e6:.3g} to {high_m * 1e6:.3g} um, as {count} "
            f"wavelengths ({enough}); {config.curvature_sensor.lenses} lenses."
        )
        if colours.law.doublet is not None:
            first, second = (f"{power:+.3g} of {name}" for power, name in zip(*_of_doublet(colours.law), strict=True))
            worst = f"{100 * colours.law.doublet.worst((low_m, high_m)):.2g} %"
            lines.append(f"Lenses: powers {first} and {second}; distance times wavelength is constant within {worst}.")
        if config.atmosphere.dispersion.zenith_deg:
            heights = [math.hypot(*one) / ARCSEC_RAD * 1e3 for one in colours.star.directions_rad]
            lines.append(f"Dispersion: colours come from up to {max(heights):.3g} mas beside the reference.")
    sensor = config.curvature_sensor
    if sensor.membrane != "none":
        lost = f", {sensor.membrane_dead_share:.0%} of the light lost in its dead time" * (
            sensor.membrane_dead_share > 0
        )
        lines.append(f"Membrane: {sensor.membrane}, {_moments_told(config)}{lost}.")
    if star.size_mas:
        lines.append(f"Star: {star.profile} of {star.size_mas:g} mas.")
    return lines


def _moments(config: Config) -> Moments:
    """Of the membrane; at rest without one."""
    settings, farthest_km = config.curvature_sensor, max(map(abs, config.curvature_sensor.distances_km))
    count = moments_needed(
        distance_m=farthest_km * 1e3,
        wavelength_m=config.beam.wavelength_um * 1e-6,
        finest_per_m=config.mirror.cutoff_cpa / config.beam.diameter_m,
    )
    return membrane_moments(settings.membrane, count=count, dead_share=settings.membrane_dead_share)


def _moments_told(config: Config) -> str:
    """Moments of the light, and of a model that follows them."""
    sensor, count = config.curvature_sensor, len(_moments(config).scales)
    if count == 1:
        return "at rest while light is integrated"
    needed = moments_of_model(
        sensor.membrane,
        distance_m=max(map(abs, sensor.distances_km)) * 1e3,
        wavelength_m=config.beam.wavelength_um * 1e-6,
        diameter_m=config.beam.diameter_m,
        dead_share=sensor.membrane_dead_share,
    )
    has = config.estimation.map.membrane_moments
    return f"{count} moments; a model follows it with {needed}, this one has {has} (estimation.map.membrane_moments)"


def _of_doublet(law: LensLaw) -> tuple[tuple[float, ...], tuple[str, ...]]:
    return ((), ()) if law.doublet is None else (law.doublet.powers, law.doublet.glasses)


def lens_law(config: Config) -> LensLaw:
    """The lenses of a configuration.

    Raises:
        SettingsError: If a glass cannot be used, or the band is wider than the doublet can serve.
        FileFormatError: If a table of the spectrum cannot be read.

    Examples:
        >>> lens_law(Config()).kind
        'achromatic'
    """
    kind, wavelength_m, band = config.curvature_sensor.lenses, config.beam.wavelength_um * 1e-6, band_of(config)
    if kind != "doublet" or band is None:
        return LensLaw("achromatic" if kind == "doublet" else kind, wavelength_m)
    first, second = config.curvature_sensor.glasses
    return LensLaw.of_glasses((first, second), wavelength_m=wavelength_m, ends_m=band.ends_m)


def _directions_rad(config: Config, wavelengths_m: tuple[float, ...]) -> list[tuple[float, float]]:
    """Where each colour comes from, (y, x)."""
    settings = config.atmosphere.dispersion
    if settings.zenith_deg == 0:
        return [(0.0, 0.0)] * len(wavelengths_m)
    towards = math.radians(settings.direction_deg)
    bent = residual_dispersion_rad(settings, wavelengths_m, wavelength_m=config.beam.wavelength_um * 1e-6)
    return [(float(angle * math.sin(towards)), float(angle * math.cos(towards))) for angle in bent]


def _images(config: Config, air: Turbulence, law: LensLaw) -> list[ColouredImage]:
    """What decides how each plane's image changes with the wavelength; both sides of the pupil are alike.

    Without an outer scale: turbulence with one is a little smoother.
    """
    static_m = config.curvature_sensor.static_rms_nm * 1e-9 * TILTED_TO_FLAT
    kolmogorov = [Turbulence(air.fried_m, air.wavelength_m)]
    if static_m:
        kolmogorov.append(Turbulence.from_rms(opd_rms_m=static_m, diameter_m=config.beam.diameter_m))

    def structure_m2(separation_m: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        return np.sum([one.structure_m2(separation_m) for one in kolmogorov], axis=0)

    segments, fringes = config.beam.segments, None
    if segments.layout != "none":
        given_m = [piston_nm * 1e-9 for piston_nm in segments.pistons_nm] or [0.0, 0.0]
        drawn = {"range_m": segments.piston_range_nm * 1e-9, "tilt_rms_m": segments.tilt_rms_nm * 1e-9}
        fringes = step_coherence(pistons_m=given_m, **drawn)

    def at(plane_m: float) -> ColouredImage:
        return ColouredImage(
            diameter_m=config.beam.diameter_m,
            distance_m=lambda colour_m: float(plane_m * law.scale((colour_m,))[0]),
            structure_m2=structure_m2,
            direction_rad=lambda colour_m: _directions_rad(config, (colour_m,))[0],
            fringes=fringes,
        )

    return [at(plane_m) for plane_m in sorted({abs(one) * 1e3 for one in config.curvature_sensor.distances_km})]
