"""What is asked about the sensitivity of sensors: which ones, at which frequencies, behind how rough a wavefront."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from nlcwfs.config import Config, load_config
from nlcwfs.config_messages import problems_in_words
from nlcwfs.errors import FileFormatError, SettingsError


class SensitivityCase(BaseModel):
    """A sensor.

    Attributes:
        name: Unique among the cases.
        sensor: Its optics.
        reconstruction: Linear ones average over wavefronts; the others use the images of each.
        set: Settings of the sensor, as on the command line.
        rms_rad: Wavefront errors at which it is asked; those of the question when left out.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    sensor: Literal["curvature", "shack-hartmann", "pyramid"] = "curvature"
    reconstruction: Literal["linear", "non-linear"] = "non-linear"
    set: tuple[str, ...] = ()
    rms_rad: tuple[Annotated[float, Field(ge=0, le=100)], ...] | None = None

    def config(self, path: Path | None, shared: Sequence[str]) -> Config:
        """Its settings, stronger than those that all share.

        Args:
            path: File of settings; None for the defaults.
            shared: Settings of all cases.

        Raises:
            SettingsError: If a setting is unknown or impossible; names the case.
        """
        try:
            return load_config(path, [*shared, *self.set])
        except SettingsError as error:
            raise SettingsError(f"case {self.name}", "; ".join(str(error).splitlines()), list(self.set)) from None


FIXED_PYRAMID = ("pyramid.pixels=128", "pyramid.margin_pixels=32", "pyramid.modulation_lambda_over_d=0")
"""Pixels as fine as the cells of the other sensors; the margin catches what edges scatter."""

PAPER = (
    SensitivityCase(
        name="Shack-Hartmann, D/d 16",
        sensor="shack-hartmann",
        reconstruction="linear",
        set=("shack_hartmann.subapertures=16",),
    ),
    SensitivityCase(
        name="Shack-Hartmann, D/d 32",
        sensor="shack-hartmann",
        reconstruction="linear",
        set=("shack_hartmann.subapertures=32",),
    ),
    SensitivityCase(
        name="curvature, 1000 km, linear",
        reconstruction="linear",
        set=("curvature_sensor.distances_km=[-1000, 1000]",),
    ),
    SensitivityCase(
        name="curvature, 800 and 2000 km, linear",
        reconstruction="linear",
        set=("curvature_sensor.distances_km=[-2000, -800, 800, 2000]",),
    ),
    SensitivityCase(name="fixed pyramid, linear", sensor="pyramid", reconstruction="linear", set=FIXED_PYRAMID),
    SensitivityCase(name="fixed pyramid, non-linear", sensor="pyramid", set=FIXED_PYRAMID),
    SensitivityCase(
        name="pyramid, 3 lambda/D, linear",
        sensor="pyramid",
        reconstruction="linear",
        set=("pyramid.pixels=128", "pyramid.margin_pixels=32", "pyramid.modulation_lambda_over_d=3"),
        rms_rad=(0,),  # 24 directions of the star for each of many wavefronts take half an hour
    ),
    SensitivityCase(name="curvature, 2500 and 3500 km, non-linear"),
    SensitivityCase(
        name="the same with 2 waves of static aberration",
        set=("curvature_sensor.static_rms_nm=1700",),
        rms_rad=(0, 4),
    ),
)
"""The sensors of Guyon 2010, Fig. 11, at 0.85 um, and a pyramid that is modulated as most are."""


class LightCells(BaseModel):
    """Cells on which the light travels.

    Attributes:
        across_pupil: Cells across the telescope.
        window: Width of the window over the diameter of the telescope.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    across_pupil: int = Field(ge=8, le=4096)
    window: float = Field(ge=1, le=32)


class SensitivityQuestion(BaseModel):
    """A question, and what is computed for its answer.

    Attributes:
        question: What is asked.
        answer: The first line of the page, written when the table is there.
        notes: The end of the page.
        set: Settings that all sensors share.
        cycles_per_aperture: Frequencies of the ripples.
        direction_deg: Where the crests of the ripples move, from +x towards +y.
        rms_rad: Errors of the wavefront, Kolmogorov's, tilt included, rms in radians at the wavelength of sensing.
        wavefronts: Wavefronts of a sensor with a non-linear reconstructor; four times as many where a mean has no
            closed form.
        flat: Cells for a flat wavefront, whose bright rim is sharp.
        rough: Cells for the others, whose light spreads.
        pixels_across_pupil: Detector pixels across the pupil; the cells themselves when left out.
        zernikes: If given, Zernikes 2 to so many are asked together instead of ripples.
        seed: Of the wavefronts.
        case: The sensors.

    Examples:
        >>> SensitivityQuestion(question="Which?", rms_rad=(0, 4)).case[0].name
        'Shack-Hartmann, D/d 16'
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    question: str
    answer: str = "Not answered yet"
    notes: str = ""
    set: tuple[str, ...] = ("beam.wavelength_um=0.85",)
    cycles_per_aperture: tuple[Annotated[float, Field(gt=0, le=1000)], ...] = Field(
        default=(1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 16.0), min_length=1
    )
    direction_deg: float = Field(default=0.0, ge=-360, le=360)
    rms_rad: tuple[Annotated[float, Field(ge=0, le=100)], ...] = Field(default=(0.0, 4.0, 8.0, 20.0), min_length=1)
    wavefronts: int = Field(default=8, ge=1, le=10_000)
    flat: LightCells = LightCells(across_pupil=512, window=2.5)
    rough: LightCells = LightCells(across_pupil=128, window=4.0)
    pixels_across_pupil: int | None = Field(default=None, ge=4, le=4096)
    zernikes: int | None = Field(default=None, ge=2, le=500)
    seed: int = Field(default=0, ge=0, lt=2**31)
    case: tuple[SensitivityCase, ...] = Field(default=PAPER, min_length=1)

    @model_validator(mode="after")
    def _pixels_are_cells(self) -> "SensitivityQuestion":
        for cells in (self.flat, self.rough):
            if self.pixels_across_pupil is not None and cells.across_pupil % self.pixels_across_pupil:
                raise ValueError(f"pixels_across_pupil must divide across_pupil ({cells.across_pupil})")
        names = [case.name for case in self.case]
        if len(set(names)) < len(names):
            raise ValueError("case.name must be unique")
        return self


def read_question(path: Path) -> SensitivityQuestion:
    """The question of a file, or of a folder with `sensitivity.toml`.

    Raises:
        FileFormatError: If the file is missing or wrong; names file and key.

    Examples:
        >>> read_question(Path("nowhere.toml"))
        Traceback (most recent call last):
        ...
        nlcwfs.errors.FileFormatError: nowhere.toml: must exist, got no such file
    """
    path = path / "sensitivity.toml" if path.is_dir() else path
    if not path.is_file():
        raise FileFormatError(f"{path}: must exist, got no such file")
    try:
        return SensitivityQuestion.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path}: must be TOML, got {error}") from None
    except ValidationError as error:
        raise FileFormatError(f"{path}: {problems_in_words(SensitivityQuestion, error)[0]}") from None
