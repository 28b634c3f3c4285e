"""`nlcwfs simulate`: a star, its frames, and the truth behind them, in one FITS file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlcwfs.beam.pupil import inside, light_weights
from nlcwfs.beam.sampling import check_sampling
from nlcwfs.beam.sampling_cost import SensedLight, light_outside
from nlcwfs.commands.console import device, percent, say, tracked, use_precision, warn
from nlcwfs.config import Config, load_config
from nlcwfs.errors import SamplingError, SettingsError
from nlcwfs.interop import FramesFile, Provenance, check_writable, write_frames
from nlcwfs.interop.frames_reconstruction import rms_m
from nlcwfs.interop.simulated_frames import Shot, frames_of, pupil_of
from nlcwfs.simulation.exposure import ExposureSimulator, distances_m, frame_key, turbulence, wavelength_m

LOSS_WORTH_A_WORD = 0.01
"""Light that leaves the light's own grid comes back in on the other side; below 1 % it drowns in photon noise."""

EXCESS_NOISE = (
    "The multiplication of electrons doubles the variance of photon noise, which no keyword of the file says: "
    "errors will be predicted about 1.4 times too small.",
)


@dataclass(frozen=True)
class SimulateOptions:
    """What the user typed."""

    out: Path
    adu: bool = False
    quiet: bool = False
    warnings: bool = True


def simulate(config: Config, options: SimulateOptions) -> None:
    """Simulate the frames of a configuration, write them, and say what was made.

    Raises:
        NlcwfsError: If a setting, the pupil's map or the output cannot be used.
    """
    check_writable(options.out)
    dtype_name = use_precision(config.precision)
    light = sensed_light(config)
    warnings = sampling_warnings(config, light) if options.warnings else []
    simulator = ExposureSimulator.build(config, pupil_of(config))
    shots = expose_all(config, simulator, quiet=options.quiet)
    frames = frames_of(config, simulator, shots)
    stamp = Provenance.collect(config.model_dump(mode="json"), seed=config.seed, device=device())
    write_frames(options.out, frames, stamp, unit="adu" if options.adu else "electron")
    for warning in [*warnings, *EXCESS_NOISE[: config.detector.em_gain > 1]]:
        warn(warning)
    for line in account(config, simulator, shots, frames):
        say(line, quiet=options.quiet)
    say(f"Wrote {options.out} ({'adu' if options.adu else 'electrons'}, {dtype_name}).", quiet=options.quiet)


def read_config(
    path: Path | None, overrides: Sequence[str], *, frames: int | None = None, seed: int | None = None
) -> Config:
    """The settings of a file, of `--set`, and of the options that have a name of their own.

    Raises:
        NlcwfsError: If the file cannot be read, or a value breaks its rule.
    """
    named = {"simulation.frames": frames, "seed": seed}
    return load_config(path, [*overrides, *(f"{key}={value}" for key, value in named.items() if value is not None)])


def expose_all(config: Config, simulator: ExposureSimulator, *, quiet: bool = False) -> list[Shot]:
    """Every frame of a configuration."""
    numbers = range(config.simulation.frames)
    return [
        Shot.of(simulator.expose(frame_key(seed=config.seed, frame=number)))
        for number in tracked(numbers, what="Simulating", total=len(numbers), quiet=quiet)
    ]


def sensed_light(config: Config) -> SensedLight:
    """The light that the detector has to sample."""
    fried_m = turbulence(config).fried_at(wavelength_m(config))
    return SensedLight(config.beam.diameter_m, wavelength_m(config), fried_m=fried_m)


def sampling_warnings(config: Config, light: SensedLight) -> list[str]:
    """What the choice of pixels and windows costs.

    Raises:
        SettingsError: If no wavefront could be found with these pixels.
    """
    detector = config.detector
    distances = sorted({abs(distance_m) for distance_m in distances_m(config)})  # both sides of the pupil cost alike
    pixel_m = config.beam.diameter_m / detector.pixels_across_pupil
    window_m = detector.window_pixels * pixel_m
    try:
        found = check_sampling(light, distances, pixel_m=pixel_m, window_m=window_m)
    except SamplingError as error:
        rule = str(error).partition(", got ")[0].replace(": ", " ", 1)
        got = f"{detector.pixels_across_pupil} ({pixel_m:.3g} m each)"
        raise SettingsError("detector.pixels_across_pupil", f"must suit the light, {rule}", got) from None
    sentences = [str(warning) for warning in found]
    wide_m = window_m * config.simulation.light_window
    lost = light_outside(light, distance_m=distances[-1], window_m=wide_m)
    if lost > LOSS_WORTH_A_WORD:
        rest = "comes back in on the other side; raise simulation.light_window"
        sentences.append(f"{percent(lost)} of the light leaves the simulated window of {wide_m:.3g} m and {rest}.")
    return sentences


def account(config: Config, simulator: ExposureSimulator, shots: Sequence[Shot], frames: FramesFile) -> list[str]:
    """What was made, a line for each thing that a user may want to know."""
    count, planes, rows, columns = frames.electrons.shape
    pupil = simulator.shape.on(simulator.frame)
    weights = light_weights(np.where(inside(pupil), pupil, 0))
    rms_nm = [rms_m(shot.truth_m, weights) * 1e9 for shot in shots]
    lost = np.mean([shot.lost for shot in shots], axis=0)
    ratio = simulator.shape.diameter_m / simulator.air.fried_at(frames.wavelength_m)
    spread = f" (frames {min(rms_nm):.0f} to {max(rms_nm):.0f} nm)" if count > 1 else ""
    electrons = frames.photo_electrons().sum(axis=(1, 2, 3)).mean()
    cells, colour = config.simulation.light_oversampling, f"{config.beam.wavelength_um:g} um"
    static_nm = config.curvature_sensor.static_rms_nm
    return [
        f"Frames: {count} of {planes} planes of {rows} x {columns} pixels, {frames.pixel_m:.3g} m each, "
        f"{config.detector.pixels_across_pupil} across the pupil.",
        f"Light: {config.atmosphere.photons:g} photons in one exposure at {colour}; "
        f"{electrons:.0f} electrons were read.",
        f"Air: D/r0 = {ratio:.1f} at {colour}; seeing {frames.seeing_arcsec:.2g} arcsec at 0.5 um.",
        f"True wavefront: {np.sqrt(np.mean(np.square(rms_nm))):.0f} nm rms on these pixels, tilt included{spread}.",
        f"Light outside the window: {', '.join(percent(float(share)) for share in lost)} of planes 1 to {planes}.",
        *([f"Static aberration: {static_nm:g} nm rms; TRUTH holds it, too."] if static_nm else []),
        f"The light travels on {simulator.light.shape[0]} x {simulator.light.shape[1]} cells, "
        f"{cells} x {cells} in a detector pixel: no model of a reconstructor made these images.",
    ]
