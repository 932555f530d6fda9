"""Settings of a calibration with a phantom: each field is an option of the command of the same name."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from calibration.detection.lines import LineSettings
from calibration.plane import PIXEL_ERROR
from calibration.solver import OUTLIER_SIGMA
from calibration.wires import BESIDE_MM
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.text import numbers
from speckle3d.io.toml import validated

Model = TypeVar("Model", bound="ScanSettings")
Corners = tuple[tuple[float, float], ...]

_MOST_FRAMES = 2**31
"""Two years at 30 frames/s."""
_MOST_LEFT_OUT = 10**6


class ScanSettings(BaseModel):
    """Which readings go with the images of a phantom, and what of them counts."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: ClassVar[str]
    """Name of the command."""

    poses: Path | None = Field(None, description="File with the sensor's readings, if not with the images.")
    transform: str | None = Field(None, description="Name of the poses in an image sequence.")
    pixel_mm: tuple[float, float] | None = Field(
        None, description="Distance between columns and rows, mm, if the recording does not say."
    )
    time_offset_s: float | Literal["estimate"] | None = Field(
        None, description="Seconds to add to the sensor's clock; by default the recording's own."
    )
    outlier_sigma: float = Field(
        OUTLIER_SIGMA, ge=1.0, description="Drop frames whose residual exceeds so many standard deviations."
    )
    region: Corners | None = Field(
        None, description="Corners (column, row) of the polygon outside which nothing counts."
    )
    leave_out: tuple[int, ...] = Field((), description="Frames left out by hand, from 0.")

    @property
    def region_px(self) -> FloatArray | None:
        """The region's corners, shape (k, 2)."""
        return None if self.region is None else np.array(self.region)


class _OfLines(ScanSettings, LineSettings):
    """Settings of a calibration with a plane."""

    @property
    def lines(self) -> LineSettings:
        """How lines are found."""
        return LineSettings(**{name: getattr(self, name) for name in LineSettings.model_fields})


class PlaneSettings(_OfLines):
    """A position sensor with a plane."""

    method: ClassVar[str] = "plane"

    fixed_pixels: bool = Field(False, description="Keep the pixel size instead of estimating it.")
    pixel_error: float = Field(
        PIXEL_ERROR, ge=0.0, description="Standard error of the pixel size, as a share of it."
    )
    stages: Literal["three", "one"] = Field("three", description="Angles, distances, all; or all at once.")
    reflector: Literal["wall", "bar"] = Field("wall", description="A bare wall, or a thin bar (Cambridge).")
    beam_mm: tuple[float, ...] | None = Field(
        None, description="Thicknesses of the beam for which the bias of a wall is predicted."
    )


class OrientationSettings(_OfLines):
    """An orientation sensor with a plane."""

    method: ClassVar[str] = "orientation"

    level: bool = Field(False, description="The plane is level: three unknowns, not five.")
    viewed_from: Literal["above", "below"] = Field(
        "above", description="Whether the beam points down on average, or up."
    )
    sensor: Literal["orientation", "tracker"] = Field(
        "orientation", description="tracker: use only what a tracker says of orientation."
    )


class WireSettings(ScanSettings):
    """A position sensor with wires."""

    method: ClassVar[str] = "wires"

    phantom: str = Field("cross", description="cross, three, or a PLUS configuration of N-wires.")
    points: Path | None = Field(None, description="CSV of points picked by hand.")
    fixed_pixels: bool = Field(False, description="Keep the pixel size instead of estimating it.")
    registration: Literal["auto", "held", "turned", "free"] = Field(
        "auto", description="How much to believe of the place that a configuration says."
    )
    beside_mm: float = Field(
        BESIDE_MM,
        ge=0,
        allow_inf_nan=False,
        description="How far out of plane a hand misses a crossing, RMS, mm.",
    )


def with_values(settings: Model, values: Mapping[str, Any]) -> Model:
    """The same settings with other values.

    Raises
    ------
    InvalidInputError
        Naming the first that is wrong.
    """
    return validated(settings.model_dump() | dict(values), settings.method, type(settings))


def region_of(text: str | None) -> Corners | None:
    """Parse the polygon "column,row column,row ...".

    Raises
    ------
    InvalidInputError
        If it is none.
    """
    if text is None:
        return None
    try:
        corners = np.array([[float(x) for x in corner.split(",")] for corner in text.split()])
    except ValueError:
        corners = np.empty(0)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise InvalidInputError(f'--region: expected at least three "column,row", got {text!r}')
    return tuple((float(column), float(row)) for column, row in corners)


def region_text(corners: Corners) -> str:
    """The polygon as `region_of` reads it."""
    return " ".join(f"{_number(column)},{_number(row)}" for column, row in corners)


def offset_of(text: str | None) -> float | Literal["estimate"] | None:
    """Parse a clock offset: seconds, or ``estimate``.

    Raises
    ------
    InvalidInputError
        If it is neither.
    """
    if text is None:
        return None
    if text == "estimate":
        return "estimate"
    try:
        (seconds,) = numbers(text, 1, "--time-offset-s")
    except InvalidInputError:
        raise InvalidInputError(f"--time-offset-s: expected seconds or `estimate`, got {text!r}") from None
    return seconds


def frames_of(text: str | None) -> tuple[int, ...]:
    """Parse numbers of frames and ranges of them, as ``3,17-20``; ascending, each once.

    Raises
    ------
    InvalidInputError
        If they are none.
    """
    found: set[int] = set()
    for part in (text or "").split(","):
        first, dash, last = (word.strip() for word in part.partition("-"))
        if not part.strip():
            continue
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


def command_line(settings: ScanSettings, images: Path, out: Path, more: Sequence[str] = ()) -> str:
    """The command that calibrates with these settings, as a shell takes it."""
    words = ["speckle3d", "calibrate", settings.method, str(images), "-o", str(out)]
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if value != field.default or name == "phantom":
            words += _option(name, value)
    return shlex.join([*words, *more])


def _option(name: str, value: Any) -> list[str]:
    option = f"--{name.replace('_', '-')}"
    if value is True:
        return [option]
    if name == "region":
        return [option, region_text(value)]
    if name == "leave_out":
        return [option, frames_text(value)]
    if name == "beam_mm":
        return [word for width in value for word in (option, _number(width))]
    if isinstance(value, tuple):
        return [option, *map(_number, value)]
    return [option, _number(value) if isinstance(value, float) else str(value)]


def _number(value: float) -> str:
    """A number in the fewest digits that read as the same."""
    return repr(float(value)).removesuffix(".0")
