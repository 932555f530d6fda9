"""Settings of a calibration with a phantom: each field is an option of the command of the same name."""

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat

from calibration.settings import LineSettings, OrientationFit, PlaneFit, WireFit
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.toml import validated

Model = TypeVar("Model", bound="ScanSettings")
Corners = tuple[tuple[float, float], ...]

_MOST_FRAMES = 10**6
"""Nine hours at 30 frames/s."""


def region_of(text: str) -> Corners | None:
    """Parse the polygon "column,row column,row ..."; nothing is the whole image.

    Raises
    ------
    InvalidInputError
        If it is none.
    """
    try:
        pairs = [corner.split(",") for corner in text.split()]
        corners = tuple((float(column), float(row)) for column, row in pairs)
    except ValueError:
        corners = ((0.0, 0.0),)
    if 0 < len(corners) < 3:
        raise InvalidInputError('expected at least three "column,row"')
    return corners or None


def frames_of(text: str) -> tuple[int, ...]:
    """Parse numbers of frames and ranges of them, as ``3,17-20``; ascending, each once.

    Raises
    ------
    InvalidInputError
        If they are none.
    """
    frames: set[int] = set()
    for part in filter(str.strip, text.split(",")):
        first, _, last = part.partition("-")
        try:
            low, high = int(first), int(last or first)
        except ValueError:
            low, high = 1, 0
        if not 0 <= low <= high < _MOST_FRAMES:
            raise InvalidInputError("expected frames as 3,17-20")
        frames.update(range(low, high + 1))
    return tuple(sorted(frames))


def _readable(parse: Callable[[str], object]) -> AfterValidator:
    """Refuse text that cannot be parsed; it stays text."""

    def check(text: str) -> str:
        parse(text)
        return text

    return AfterValidator(check)


class ScanSettings(BaseModel):
    """Settings of a phantom's scan: sensor readings, region, and frames left out."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: ClassVar[str]
    """Name of the command."""

    poses: Path | None = Field(None, description="File with the sensor's readings, if not in IMAGES.")
    transform: str | None = Field(
        None,
        description="Poses to use, by their name in an image sequence, as ToolToTracker (ProbeToTracker).",
    )
    pixel_mm: tuple[float, float] | None = Field(
        None, description="Distance between columns and rows, mm, if IMAGES does not say."
    )
    time_offset_s: FiniteFloat | Literal["estimate"] | None = Field(
        None, description="Seconds to add to the sensor's clock, or `estimate`."
    )
    region: Annotated[str, _readable(region_of)] = Field(
        "", description='Polygon "column,row column,row ..." outside which nothing counts.'
    )
    leave_out: Annotated[str, _readable(frames_of)] = Field(
        "", description="Frames to leave out, from 0, as 3,17-20."
    )
    validation: Path | None = Field(
        None, description="Another recording of the phantom, on which the calibration is checked."
    )

    @property
    def corners(self) -> Corners | None:
        """Corners of the region, as `region_of`."""
        return region_of(self.region)

    @property
    def frames_left_out(self) -> tuple[int, ...]:
        """Numbers, as `frames_of`."""
        return frames_of(self.leave_out)


class PlaneSettings(PlaneFit, LineSettings, ScanSettings):
    """A position sensor with a plane."""

    method: ClassVar[str] = "plane"

    reflector: Literal["wall", "bar"] = Field(
        "wall", description="A bare wall, whose bias is predicted, or a thin bar (Cambridge)."
    )
    beam_mm: list[float] | None = Field(
        None, description="Thickness of the beam for that prediction; may be repeated."
    )


class OrientationSettings(OrientationFit, LineSettings, ScanSettings):
    """An orientation sensor with a plane."""

    method: ClassVar[str] = "orientation"

    sensor: Literal["orientation", "tracker"] = Field(
        "orientation", description="orientation, or tracker: use only what a tracker says of orientation."
    )


class WireSettings(WireFit, ScanSettings):
    """A position sensor with wires."""

    method: ClassVar[str] = "wires"

    phantom: str = Field("cross", description="cross, three, or a PLUS configuration of N-wires.")
    points: Path | None = Field(
        None, description="CSV of points picked by hand: frame,column_px,row_px[,wire]."
    )
    validation_points: Path | None = Field(
        None, description="With --validation: CSV of points picked by hand in that other recording."
    )


def model_of(method: str) -> type[ScanSettings]:
    """The settings of a method, as ``plane``."""
    return {model.method: model for model in (PlaneSettings, OrientationSettings, WireSettings)}[method]


def with_values(settings: Model, values: Mapping[str, Any]) -> Model:
    """Copy of the settings with other values.

    Raises
    ------
    InvalidInputError
        Naming the first that is wrong.
    """
    return validated(settings.model_dump() | dict(values), settings.method, type(settings))


def command_line(settings: ScanSettings, images: Path, out: Path) -> str:
    """The command that calibrates with these settings, as a shell takes it."""
    words = ["speckle3d", "calibrate", settings.method, str(images), "-o", str(out)]
    for name, field in type(settings).model_fields.items():
        value, option = getattr(settings, name), f"--{name.replace('_', '-')}"
        if value != field.default or name == "phantom":
            for item in value if isinstance(value, list) else [value]:
                arguments = item if isinstance(item, tuple) else [] if item is True else [item]
                words += [option, *map(str, arguments)]
    return shlex.join(words)
