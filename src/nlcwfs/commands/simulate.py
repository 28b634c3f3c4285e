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
from nlcwfs.curvature_sensor.step_visibility import SeenPlanes, unseen_step
from nlcwfs.errors import SamplingError, SettingsError
from nlcwfs.interop import FramesFile, Provenance, check_writable, write_frames
from nlcwfs.interop.frames_reconstruction import rms_m
from nlcwfs.interop.simulated_frames import Shot, frames_of, pupil_of
from nlcwfs.simulation.colours import colour_account
from nlcwfs.simulation.exposure import ExposureSimulator, distances_m, frame_key, turbulence, wavelength_m
from nlcwfs.simulation.scintillation import scintillation_account
from nlcwfs.simulation.sequence import SequenceSimulator, wind_layers
from nlcwfs.simulation.starlight import starlight_per_s, with_exposures_of

LOSS_WORTH_A_WORD = 0.01
"""Light that leaves the light's own grid comes back in on the other side; below 1 % it drowns in photon noise."""

STEP_WORTH_A_WORD = 0.25
"""Way of the air between two moments of an exposure, over r0, above which the images are off by more than 1 %: the
speckles of Table 1 at 100 Hz (0.65 um) change by 0.2 % with 0.11 r0, by 0.7 % with 0.22, by 3 % with 0.43."""

EXCESS_NOISE = (
    "The multiplication of electrons doubles the variance of photon noise, which no keyword of the file says: "
    "errors will be predicted about 1.4 times too small.",
)

NO_LENGTH = (
    "A single exposure has no length: atmosphere.photons rules, and atmosphere.star and photons_per_s are for a "
    "sequence or a loop."
)


@dataclass(frozen=True)
class SimulateOptions:
    """What the user typed."""

    out: Path
    adu: bool = False
    quiet: bool = False
    warnings: bool = True
    sequence: bool = False


def simulate(config: Config, options: SimulateOptions) -> None:
    """Simulate the frames of a configuration, write them, and say what was made.

    Raises:
        NlcwfsError: If a setting, the pupil's map or the output cannot be used.
    """
    check_writable(options.out)
    dtype_name = use_precision(config.precision)
    stamp = Provenance.collect(config.model_dump(mode="json"), seed=config.seed, device=device())
    starlit = starlight_per_s(config) is not None
    if options.sequence and config.simulation.rate_hz is not None:
        config = with_exposures_of(config, config.simulation.rate_hz)
    light = sensed_light(config)
    warnings = sampling_warnings(config, light) if options.warnings else []
    if options.sequence:
        sequence = SequenceSimulator.build(config, pupil_of(config))
        simulator, rate_hz = sequence.still, sequence.rate_hz
        shots = expose_sequence(config, sequence, quiet=options.quiet)
        warnings += motion_warnings(config, sequence) if options.warnings else []
    else:
        warnings += [NO_LENGTH] if starlit and options.warnings else []
        sequence, simulator, rate_hz = None, ExposureSimulator.build(config, pupil_of(config)), None
        check_steps(config, simulator)
        shots = expose_all(config, simulator, quiet=options.quiet)
    frames = frames_of(config, simulator, shots, rate_hz=rate_hz)
    write_frames(options.out, frames, stamp, unit="adu" if options.adu else "electron")
    for warning in [*warnings, *EXCESS_NOISE[: config.detector.em_gain > 1]]:
        warn(warning)
    moved = [] if sequence is None else sequence_account(config, sequence)
    for line in [*account(config, sequence or simulator, shots, frames), *moved]:
        say(line, quiet=options.quiet)
    say(f"Wrote {options.out} ({'adu' if options.adu else 'electrons'}, {dtype_name}).", quiet=options.quiet)


def read_config(
    path: Path | None,
    overrides: Sequence[str],
    *,
    frames: int | None = None,
    seed: int | None = None,
    rate_hz: float | None = None,
    sequence: bool = False,
) -> Config:
    """The settings of a file, of `--set`, and of the options that have a name of their own.

    Raises:
        NlcwfsError: If the file cannot be read, if a value breaks its rule, or if a rate is given for no sequence.
    """
    if rate_hz is not None and not sequence:
        raise SettingsError("--rate", "must come with --sequence", f"{rate_hz:g} without")
    named = {"simulation.frames": frames, "seed": seed, "simulation.rate_hz": rate_hz}
    return load_config(path, [*overrides, *(f"{key}={value}" for key, value in named.items() if value is not None)])


def expose_all(config: Config, simulator: ExposureSimulator, *, quiet: bool = False) -> list[Shot]:
    """Every frame of a configuration."""
    numbers = range(config.simulation.frames)
    return [
        Shot.of(simulator.expose(frame_key(seed=config.seed, frame=number)))
        for number in tracked(numbers, what="Simulating", total=len(numbers), quiet=quiet)
    ]


def expose_sequence(config: Config, sequence: SequenceSimulator, *, quiet: bool = False) -> list[Shot]:
    """Every frame of a sequence, in the order of time."""
    numbers = range(config.simulation.frames)
    return [
        Shot.of(sequence.expose(number))
        for number in tracked(numbers, what="Simulating", total=len(numbers), quiet=quiet)
    ]


def sensed_light(config: Config) -> SensedLight:
    """The light that the detector has to sample."""
    fried_m = turbulence(config).fried_at(wavelength_m(config))
    return SensedLight(config.beam.diameter_m, wavelength_m(config), fried_m=fried_m)


def check_steps(config: Config, simulator: ExposureSimulator) -> None:
    """Refuse planes on which the light of some segment meets that of no other.

    Raises:
        SettingsError: If there is such a segment; says by how many photons its step is told.
    """
    labels = simulator.shape.labels(simulator.frame)
    if labels is None:
        return
    sensor, grid = config.curvature_sensor, simulator.frame
    planes = SeenPlanes(distances_m(config), wavelength_m(config), sensor.flux_fractions)
    found = unseen_step(simulator.shape.on(grid), labels, grid, photons=config.atmosphere.photons, planes=planes)
    if found is not None:
        rule = "must be so far out that light crosses the gaps between segments: the step of segment "
        rule += f"{found[0]} is not observable, {found[1]:.2g} photons tell it"
        raise SettingsError("curvature_sensor.distances_km", rule, list(sensor.distances_km))


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


def motion_warnings(config: Config, sequence: SequenceSimulator) -> list[str]:
    """What the choice of moments in an exposure costs."""
    fried_m = sequence.still.air.fried_at(wavelength_m(config))
    step_m = max(layer.speed_m_per_s for layer in wind_layers(config)) / sequence.rate_hz / sequence.substeps
    if step_m <= STEP_WORTH_A_WORD * fried_m:
        return []
    moments = f"{sequence.substeps} moments of an exposure"
    return [
        f"The air moves {step_m:.2g} m between the {moments}, {step_m / fried_m:.2g} of r0; raise simulation.substeps."
    ]


def sequence_account(config: Config, sequence: SequenceSimulator) -> list[str]:
    """What moved, a line for each thing that a user may want to know."""
    frames, exposure_s = config.simulation.frames, 1 / sequence.rate_hz
    winds = [
        f"{layer.speed_m_per_s:g} m/s towards {layer.direction_deg:g} deg"
        + (f" ({percent(layer.fraction)} of the turbulence)" if layer.fraction < 1 else "")
        for layer in wind_layers(config)
    ]
    return [
        f"Sequence: {frames} successive exposures at {sequence.rate_hz:g} Hz, {frames * exposure_s:.3g} s of one sky; "
        f"at most {sequence.longest:g} frames of it are new air.",
        f"Wind: {', '.join(winds)}. The light is summed over {sequence.substeps} moments of each exposure of "
        f"{exposure_s * 1e3:.3g} ms; TRUTH is its mean wavefront.",
    ]


def account(
    config: Config, light: ExposureSimulator | SequenceSimulator, shots: Sequence[Shot], frames: FramesFile
) -> list[str]:
    """What was made, a line for each thing that a user may want to know."""
    simulator = light.still if isinstance(light, SequenceSimulator) else light
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
        *colour_account(config, simulator.air),
        f"Air: D/r0 = {ratio:.1f} at {colour}; seeing {frames.seeing_arcsec:.2g} arcsec at 0.5 um.",
        *scintillation_account(config, simulator.air, light.log_variance),
        f"True wavefront: {np.sqrt(np.mean(np.square(rms_nm))):.0f} nm rms on these pixels, tilt included{spread}.",
        f"Light outside the window: {', '.join(percent(float(share)) for share in lost)} of planes 1 to {planes}.",
        *([f"Static aberration: {static_nm:g} nm rms; TRUTH holds it, too."] if static_nm else []),
        f"The light travels on {simulator.light.shape[0]} x {simulator.light.shape[1]} cells, "
        f"{cells} x {cells} in a detector pixel: no model of a reconstructor made these images.",
    ]
