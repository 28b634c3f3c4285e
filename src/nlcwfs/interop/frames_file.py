"""The frames of a sensor, with all that a reconstructor must know about them."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from nlcwfs.errors import SettingsError


@dataclass(frozen=True, eq=False, kw_only=True)
class FramesFile:
    """Frames of a sensor, with all that a reconstructor must know about them.

    Attributes:
        electrons: What the pixels hold, background and dark included; 0 where nothing finite was read.
        masked: Pixels not to be used: in `bad_pixels`, NaN, infinite or saturated.
        has_frame_axis: Whether the file has a frame axis; without it there is one frame here.
        pixel_m: Width of a pixel at the scale of the telescope.
        distances_m: Signed distance of every plane from the pupil, positive downstream.
        obstruction_ratio: Diameter of the central obstruction over that of the telescope.
        bandwidth_m: Width of the band; 0 is one colour.
        chromatic_lenses: Whether distance times wavelength is constant; the distances are at `wavelength_m`.
        membrane: How a membrane moves the planes while light is integrated; the distances are then the mean ones.
        membrane_dead_share: Of the time, in which nothing is integrated.
        gain_electrons_per_adu: Gain of the detector, if known.
        read_noise_electrons: Its rms; 0 when the file does not say.
        dark_electrons: Dark electrons in every pixel of a frame.
        saturation_electrons: A pixel this bright is full, if known.
        flux_fractions: Share of the light of each plane, sum 1; None for equal shares.
        seeing_arcsec: Seeing at 500 nm.
        photons: Photo-electrons that the whole sensor is expected to have of the star in an exposure, if known.
        times_s: When each frame was taken, ascending; None for frames at `rate_hz`, or without an order in time.
        pupil: Amplitude of the pupil, 0 to 1; None for a circle with its obstruction.
        segments: Segment of every pixel, from 0, where the pupil has several that may have steps between them.
        background: Background in electrons, one image for all planes or one per plane.
        bad_pixels: Pixels to ignore, one map for all planes or one per plane.
        truth_m: The true wavefront, one for all frames or one per frame; may be NaN outside the pupil.
        frame_problems: Frames that cannot be used, by number from 0, and why.
        warnings: What the user should know, a sentence each.
        source: The file it was read from.
        source_digest: First digits of the SHA-256 of that file, to know it again.

    Raises:
        SettingsError: If the arrays contradict each other.

    Examples:
        >>> frames = FramesFile(
        ...     electrons=np.ones((1, 2, 8, 8)), masked=np.zeros((1, 2, 8, 8), bool), has_frame_axis=False,
        ...     pixel_m=1.0, wavelength_m=0.65e-6, diameter_m=8.0, distances_m=(-2.5e6, 2.5e6),
        ...     dark_electrons=0.25,
        ... )
        >>> float(frames.photo_electrons().sum())
        96.0
    """

    electrons: Float[np.ndarray, "frame plane y x"]
    masked: Bool[np.ndarray, "frame plane y x"]
    has_frame_axis: bool
    pixel_m: float
    wavelength_m: float
    diameter_m: float
    distances_m: tuple[float, ...]
    obstruction_ratio: float = 0.0
    bandwidth_m: float = 0.0
    chromatic_lenses: bool = False
    membrane: Literal["none", "sine", "square"] = "none"
    membrane_dead_share: float = 0.0
    gain_electrons_per_adu: float | None = None
    read_noise_electrons: float = 0.0
    dark_electrons: float = 0.0
    saturation_electrons: float | None = None
    flux_fractions: tuple[float, ...] | None = None
    exposure_s: float | None = None
    seeing_arcsec: float | None = None
    rate_hz: float | None = None
    photons: float | None = None
    times_s: Float[np.ndarray, " frame"] | None = None
    pupil: Float[np.ndarray, "y x"] | None = None
    segments: Int[np.ndarray, "y x"] | None = None
    background: Float[np.ndarray, "..."] | None = None
    bad_pixels: Bool[np.ndarray, "..."] | None = None
    truth_m: Float[np.ndarray, "..."] | None = None
    frame_problems: dict[int, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    source: str = ""
    source_digest: str = ""

    def __post_init__(self) -> None:
        shape = self.electrons.shape
        if len(self.distances_m) != shape[1]:
            raise SettingsError("frames.distances_m", f"must be one per plane, {shape[1]}", self.distances_m)
        if not self.has_frame_axis and shape[0] != 1:
            raise SettingsError("frames.has_frame_axis", "must be true for several frames", shape[0])
        allowed = {
            "masked": (shape,),
            "pupil": (shape[2:],),
            "segments": (shape[2:],),
            "background": (shape[2:], shape[1:]),
            "bad_pixels": (shape[2:], shape[1:]),
            "truth_m": (shape[2:], (shape[0], *shape[2:])),
            "times_s": (shape[:1],),
        }
        for name, shapes in allowed.items():
            array = getattr(self, name)
            if array is not None and array.shape not in shapes:
                raise SettingsError(f"frames.{name}", f"must have the pixels of the frames, {shapes[0]}", array.shape)

    def photo_electrons(self) -> Float[np.ndarray, "frame plane y x"]:
        """The light alone: electrons less background and dark; 0 in masked pixels."""
        level = self.dark_electrons + (0.0 if self.background is None else self.background)
        return np.where(self.masked, 0.0, self.electrons - level)
