"""Settings of a calibration with a phantom: each field is an option of the command of the same name."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from calibration.settings import LineSettings, OrientationFit, PlaneFit, WireFit
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.toml import validated

Model = TypeVar("Model", bound="ScanSettings")
Corners = tuple[tuple[float, float], ...]

_MOST_FRAMES = 2**31
"""Two years at 30 frames/s."""
_MOST_LEFT_OUT = 10**6


class AsText(NamedTuple):
    """How a setting is written that is one word of a command."""

    write: Callable[[Any], str]


def region_of(text: str) -> Corners | None:
    """Parse the polygon "column,row column,row ..."; nothing is the whole image.

    Raises
    ------
    InvalidInputError
        If it is none.
    """
    if not text:
        return None
    try:
        corners = [[float(x) for x in corner.split(",")] for corner in text.split()]
    except ValueError:
        corners = []
    if len(corners) < 3 or any(len(corner) != 2 for corner in corners):
        raise InvalidInputError(f'--region: expected at least three "column,row", got {text!r}')
    return tuple((column, row) for column, row in corners)


def offset_of(text: str) -> float | Literal["estimate"] | None:
    """Parse a clock offset: seconds, or ``estimate``; nothing is the recording's own.

    Raises
    ------
    InvalidInputError
        If it is neither.
    """
    if text in ("", "estimate"):
        return "estimate" if text else None
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise InvalidInputError(f"--time-offset-s: expected seconds or `estimate`, got {text!r}")
    return seconds


def frames_of(text: str) -> tuple[int, ...]:
    """Parse numbers of frames and ranges of them, as ``3,17-20``; ascending, each once.

    Raises
    ------
    InvalidInputError
        If they are none.
    """
    found: set[int] = set()
    for part in filter(str.strip, text.split(",")):
        first, dash, last = (word.strip() for word in part.partition("-"))
        ends = (first, last if dash else first)
        if not all(end.isascii() and end.isdigit() and len(end) < 11 for end in ends):
            raise InvalidInputError(f"--leave-out: expected frames as 3,17-20, got {text!r}")
        low, high = (int(end) for end in ends)
        if not low <= high < _MOST_FRAMES or high - low >= _MOST_LEFT_OUT:
            raise InvalidInputError(f"--leave-out: expected frames as 3,17-20, got {part.strip()!r}")
        found.update(range(low, high + 1))
    return tuple(sorted(found))


def frames_text(frames: Iterable[int]) -> str:
    """Numbers of frames as `frames_of` reads them."""
    runs: list[list[int]] = []
    for frame in sorted(set(frames)):
        if runs and frame == runs[-1][-1] + 1:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    return ",".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def number_text(value: float) -> str:
    """A number in the fewest digits that read as the same."""
    return repr(float(value)).removesuffix(".0") if isinstance(value, float) else str(value)


def region_text(corners: Corners) -> str:
    """The polygon as `region_of` reads it."""
    return " ".join(f"{number_text(column)},{number_text(row)}" for column, row in corners)


def _parsed(parse: Callable[[str], Any]) -> BeforeValidator:
    """Take text, as in a command, or the value itself."""
    return BeforeValidator(lambda value: parse(value) if isinstance(value, str) else value)


class ScanSettings(BaseModel):
    """Which readings go with the images of a phantom, and what of them counts."""

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
    time_offset_s: Annotated[float | Literal["estimate"] | None, _parsed(offset_of), AsText(number_text)] = (
        Field(None, description="Seconds to add to the sensor's clock, or `estimate`.")
    )
    region: Annotated[Corners | None, _parsed(region_of), AsText(region_text)] = Field(
        None, description='Polygon "column,row column,row ..." outside which nothing counts.'
    )
    leave_out: Annotated[tuple[int, ...], _parsed(frames_of), AsText(frames_text)] = Field(
        (), description="Frames to leave out, from 0, as 3,17-20."
    )
    validation: Path | None = Field(
        None, description="Another recording of the phantom, on which the calibration is checked."
    )


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
        None, description="CSV of points picked by hand in that other recording."
    )


def model_of(method: str) -> type[ScanSettings]:
    """The settings of a method, as ``plane``."""
    return {one.method: one for one in (PlaneSettings, OrientationSettings, WireSettings)}[method]


def with_values(settings: Model, values: Mapping[str, Any]) -> Model:
    """The same settings with other values.

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
        if value == field.default and name != "phantom":
            continue
        if isinstance(value, list):
            words += [word for one in value for word in (option, number_text(one))]
        elif texts := [one for one in field.metadata if isinstance(one, AsText)]:
            words += [option, texts[0].write(value)]
        else:
            words += [
                option,
                *map(number_text, value if isinstance(value, tuple) else () if value is True else (value,)),
            ]
    return shlex.join(words)
