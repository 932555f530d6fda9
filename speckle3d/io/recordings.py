"""A recording of any format: its frames, what it says of them and where each number is from.

A number comes from the file, from options or, where all scanners have the same, is assumed; each is told with
its source, as in "0.05 (given by import.toml, the file says 0.2)". What is in none of these is asked for, all
at once. Readers fill a `Recording`; it makes the sweep, describes itself and tells contradictions.
"""

from collections import defaultdict
from collections.abc import Generator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError, naming
from speckle3d.core.grid import ImageGrid
from speckle3d.core.images import USUAL_PIXEL_MM, estimate_dynamic_range
from speckle3d.core.sweep import BModeSettings, OrientationSensor, RFSettings, Sweep, Tracker
from speckle3d.core.text import printable
from speckle3d.io.hdf5 import reading
from speckle3d.io.import_settings import (
    SPEED_OF_SOUND_M_S,
    ImportSettings,
    MissingSettingsError,
    option_of,
    settings_file,
    settings_for,
)
from speckle3d.io.pose_paths import checked_path, usable

Row = tuple[str, str, str]
"""Description, value, unit."""

SPREAD = 1e-3
"""How far steps of an axis may be from their mean, as a share: rounding of single precision in metres."""

CONTRADICTION = 0.01
"""Difference, as a share, above which a number that is given contradicts what a file says."""

_SPREADING = ("array_radius_mm", "line_angles_deg")
"""What places lines that are not parallel."""
_RATES = ("sampling_rate_hz", "centre_frequency_hz", "bandwidth_hz")
_UNITS = {"hz": "MHz", "frame": "Hz", "mm": "mm", "db": "dB", "deg": "deg", "s": "m/s"}
"""Of numbers as they are shown."""
_ASSUMPTION = "assumed"


@dataclass(frozen=True)
class Value:
    """A number of a recording, and where it is from; None if the recording does not give it.

    Attributes
    ----------
    source : str
        As shown; begins with "assumed" if nobody says it.
    """

    value: Any = None
    source: str = ""

    @property
    def is_assumption(self) -> bool:
        """Whether the number is assumed."""
        return self.source.startswith(_ASSUMPTION)


ASSUMPTIONS = {
    "speed_of_sound_m_s": Value(SPEED_OF_SOUND_M_S, _ASSUMPTION),
    "first_sample_depth_mm": Value(0.0, _ASSUMPTION),
}


@dataclass(frozen=True)
class Recording:
    """A recording as read: frames, metadata with sources, sensors, notes.

    Attributes
    ----------
    settings : ImportSettings
        What is given over the recording's own numbers.
    frames : Frames, optional
        uint8 for B-mode, real for RF, complex for I/Q; a NumPy array, or with its method `take`.
    values : mapping of str to Value
        By the name of a setting. A pitch of vectors is one of columns, too; a spacing of rows makes a
        sampling rate where there is none.
    time_s : ndarray, shape (n,), optional
        NaN where a frame has none; frames whose time is not after the one before are left out. By default
        of the frame rate, from 0.
    faults : sequence of str, length n
        Why a frame is of no use, empty where it is; by default all are.
    chain : str
        Transforms that the tracker's poses were made of.
    substitutes : mapping of str to str
        Settings to ask for in place of others, as the probe's model for a distance.
    assumptions : sequence of str
        What no file says and is taken for granted.
    rows : sequence of Row
        Facts of the file that are no numbers of a sweep.
    remarks : sequence of str
        What is to be told when the recording is used: rows left out, contradictions of its own.
    fault : Speckle3DError, optional
        Why there is no sweep in it.
    ready : Sweep, optional
        The sweep itself, of formats that say all.
    """

    path: Path
    settings: ImportSettings = field(default_factory=ImportSettings)
    frames: Any = None
    values: Mapping[str, Value] = field(default_factory=dict)
    time_s: FloatArray | None = None
    faults: Sequence[str] = ()
    tracker: Tracker | None = None
    orientation: OrientationSensor | None = None
    chain: str = "the tracker"
    probe: str = ""
    name: str = ""
    full_scale: float = 255.0
    substitutes: Mapping[str, str] = field(default_factory=dict)
    assumptions: Sequence[str] = ()
    rows: Sequence[Row] = ()
    remarks: Sequence[str] = ()
    fault: Speckle3DError | None = None
    ready: Sweep | None = None

    @property
    def sweep(self) -> Sweep:
        """The sweep; jumps of its tracker are left out.

        Raises
        ------
        MissingSettingsError
            Naming all that neither the recording nor the settings give.
        FileError, InvalidInputError
            If there is none, or its numbers cannot be those of echoes.
        """
        return self._sweep_and_notes[0]

    @property
    def notes(self) -> list[str]:
        """Notes on how the sweep was made."""
        return self.notes_without()

    def notes_without(self, *settings: str) -> list[str]:
        """Notes, but for assumptions of settings that are not needed."""
        assumptions = [
            " ".join(number_row(name, value.value))
            for name, value in self.numbers.items()
            if value.is_assumption and name not in (*self._options, *settings)
        ]
        assumptions += self.assumptions
        words = [f"assumed, as the file does not say: {', '.join(assumptions)}"] if assumptions else []
        contradictions = filter(None, (self._number(name)[1] for name in self.numbers))
        return [*contradictions, *self._oddities, *words]

    def describe(self) -> list[Row]:
        """Rows of what the file says, where each number is from, and what is odd."""
        numbers = (self._number(name)[0] for name in self.numbers)
        return [*self.rows, *numbers, *(("note", text, "") for text in self._oddities)]

    @cached_property
    def _oddities(self) -> list[str]:
        """Notes on oddities of frames, file and path."""
        remarks = [*self._frame_times[2], *self.remarks]
        with suppress(Speckle3DError):  # which is told by who asks for the sweep
            remarks += self._sweep_and_notes[1]
        return remarks

    def _number(self, name: str) -> tuple[Row, str]:
        """Row of a number; and a line where it is given and the recording says another, by more than 1 %."""
        value, setting = self.numbers[name], self._options.get(name)
        words, number, unit = number_row(name, () if value.value is None else value.value)
        source = f" ({value.source})" if value.source else ""
        if setting is None:
            option = f"missing: {option_of(self.substitutes.get(name, name))}"
            return ((words, f"{number}{source}", unit) if number else (words, option, "")), ""
        text, giver = number_row(name, setting)[1], "given"
        if (file := settings_file(self.path)) and getattr(settings_for(self.path), name) == setting:
            giver = f"given by {file.name}"
        if not number or value.is_assumption or text == number:
            return (words, f"{text} ({giver})", unit), ""
        against = f"the file says {number}"
        contradiction = f"{words} {text} {unit}, {giver}: {against}{source}"
        return (words, f"{text} ({giver}, {against})", unit), contradiction * differs(setting, value.value)

    @cached_property
    def numbers(self) -> dict[str, Value]:
        """The numbers that a sweep of these frames needs, by the names of their settings."""
        if self.frames is None:
            return {}
        dtype = np.dtype(self.frames.dtype)
        is_grey, is_fan = dtype == np.uint8, not {*self.values, *self._options}.isdisjoint(_SPREADING)
        pitch = "column_pitch_mm" if is_grey else "vector_pitch_mm"
        names = ["first_sample_depth_mm", *(_SPREADING if is_fan else [pitch])]
        names += ["row_spacing_mm", "dynamic_range_db"] if is_grey else ["speed_of_sound_m_s", *_RATES]
        if dtype.kind == "c":
            names.append("demodulation_frequency_hz")
        values, times = self._file_values, self._frame_times[0]
        if "frame_rate_hz" in self._options or (times is None and self.frames.shape[0] > 1):
            names.append("frame_rate_hz")
        if times is not None:
            values.setdefault("frame_rate_hz", Value(rate_of(times), "of its times"))
        if "dynamic_range_db" in names and values["dynamic_range_db"].value is None and self._range:
            source = f"{_ASSUMPTION}, +- {self._range[1]:.1f} by its speckle"
            values["dynamic_range_db"] = Value(round(self._range[0], 1), source)
        return {name: values[name] for name in names}

    @cached_property
    def _options(self) -> dict[str, Any]:
        """Settings that are given."""
        return self.settings.model_dump(exclude_none=True)

    @cached_property
    def _file_values(self) -> defaultdict[str, Value]:
        """Numbers that the recording gives, or all scanners have."""
        values = defaultdict(Value, ASSUMPTIONS | {**self.values})
        values.setdefault("column_pitch_mm", values["vector_pitch_mm"])
        if (spacing := values["row_spacing_mm"]).value is not None and "sampling_rate_hz" not in values:
            values["sampling_rate_hz"] = rate_by_spacing(spacing, self.settings, values)
        return values

    @cached_property
    def _range(self) -> tuple[float, float] | None:
        """Dynamic range by the images' speckle where nobody gives it, and its standard deviation, dB."""
        if "dynamic_range_db" in self._options:
            return None
        pitch_mm, spacing_mm = (
            self._options.get(name) or self._file_values[name].value or USUAL_PIXEL_MM
            for name in ("column_pitch_mm", "row_spacing_mm")
        )
        return estimate_dynamic_range(self._images, pitch_mm, spacing_mm, self.full_scale)

    @cached_property
    def _frame_times(self) -> tuple[FloatArray | None, IntArray, list[str]]:
        """The file's times of frames, if it has them, the frames of use, and a line of the others."""
        if self.frames is None:
            return None, np.arange(0), []
        times, rate_hz, count = None, self.settings.frame_rate_hz, self.frames.shape[0]
        if self.time_s is not None:
            rows, notes = usable("images", self.time_s, self.faults)
            times = self.time_s[rows] if rows.size >= min(2, count) else None
        if times is None or rate_hz is not None:
            with reading(f"{self.path}: {count} frames"):
                rows, notes = usable("images", np.arange(count) / (rate_hz or 1.0), self.faults)
        return times, rows, notes

    @cached_property
    def _images(self) -> Any:
        """The frames of use."""
        rows = self._frame_times[1]
        return self.frames if rows.size == self.frames.shape[0] else self.frames.take(rows, 0)

    @cached_property
    def _sweep_and_notes(self) -> tuple[Sweep, list[str]]:
        with naming(str(self.path)):
            sweep = self._build() if self.ready is None else self.ready
            require_plausible(sweep)
            sweep, notes = checked_path(sweep, self.chain)
        # Of a format that says all, its poses are told where something is odd of them.
        return sweep, notes if self.ready is None or len(notes) > 1 else []

    def _build(self) -> Sweep:
        if self.fault is not None:
            raise self.fault
        times, rows, _ = self._frame_times
        if self.frames is None or 0 in (rows.size, *self.frames.shape):
            raise InvalidInputError(f"{self.path}: expected frames, got none")
        frames = self._images
        values = {name: self._options.get(name, value.value) for name, value in self.numbers.items()}
        lacks = {self.substitutes.get(name, name): None for name, number in values.items() if number is None}
        if lacks:
            raise MissingSettingsError(self.path, tuple(lacks))
        if (rate_hz := values.get("frame_rate_hz")) is not None:
            times = rows / float(rate_hz)
        signal: RFSettings | BModeSettings
        if "dynamic_range_db" in values:
            is_assumption = self.numbers["dynamic_range_db"].is_assumption
            sigma_db = self._range[1] if is_assumption and self._range else 0.0
            signal = BModeSettings(values["dynamic_range_db"], self.full_scale, sigma_db)
            spacing = values["row_spacing_mm"]
        else:
            names = {part.name for part in fields(RFSettings)} & values.keys()
            signal = RFSettings(**{name: values[name] for name in names})
            spacing = signal.sample_spacing_mm
        pitch = values.get("column_pitch_mm", values.get("vector_pitch_mm"))
        _, vectors, samples = frames.shape
        first_mm = values["first_sample_depth_mm"]
        if pitch is None:
            first, last = np.deg2rad(values["line_angles_deg"]).tolist()
            radius_mm = values["array_radius_mm"]
            grid = ImageGrid.of_fan(vectors, samples, spacing, radius_mm, (first, last), first_mm)
        else:
            grid = ImageGrid(vectors, samples, pitch, spacing, first_mm)
        return Sweep(
            frames=frames,
            grid=grid,
            signal=signal,
            frame_time_s=np.zeros(1) if times is None else times,
            tracker=self.tracker,
            orientation=self.orientation,
            name=printable(self.name or self.path.name.split(".")[0]),
            probe=self.probe or self.settings.probe or "",
        )


Facts = Generator[Row, None, Recording]
"""What a reader's generator is: it yields rows of facts and returns the recording."""


def rate_by_spacing(spacing: Value, settings: ImportSettings, values: Mapping[str, Value]) -> Value:
    """Sampling rate by the spacing of samples and the speed of sound that is given, said or assumed."""
    file_speed = values.get("speed_of_sound_m_s", Value()).value
    speed = float(settings.speed_of_sound_m_s or file_speed or SPEED_OF_SOUND_M_S)
    words = f"of samples {spacing.value:.6g} mm apart, {spacing.source}, at {speed:g} m/s"
    return replace(spacing, value=1e3 * speed / (2.0 * spacing.value), source=words)


def differs(a: Any, b: Any) -> bool:
    """Whether two values are further apart than `CONTRADICTION`."""
    return not np.allclose(a, b, rtol=CONTRADICTION, atol=0)


def rate_of(time_s: FloatArray) -> float | None:
    """Mean frame rate of times, Hz; None for fewer than two, or if they do not rise."""
    span = float(time_s[-1] - time_s[0]) if time_s.size > 1 else 0.0
    return (time_s.size - 1) / span if span > 0 else None


def step_of(axis: FloatArray, where: str) -> float:
    """Distance between neighbours of an axis.

    Raises
    ------
    InvalidInputError
        If it does not rise in even steps.
    """
    steps = np.diff(axis)
    step = float(steps.mean()) if steps.size else np.nan
    # Single precision far from zero rounds to a share of the position, not of the step.
    tolerance = SPREAD * step + 4e-7 * float(np.abs(axis).max(initial=0.0))
    if not (step > 0 and np.abs(steps - step).max() <= tolerance):
        words = np.array2string(axis, precision=4, threshold=6).replace("\n", "")
        raise InvalidInputError(f"{where}: expected positions that rise in even steps, got {words}")
    return step


def number_row(name: str, value: Any) -> Row:
    """A number, or a low and a high one, by the name of its setting, in words and the unit that is shown."""
    *words, unit = name.split("_")
    text = _UNITS[unit if words[0] != "frame" else "frame"]
    numbers = " to ".join(f"{number / 1e6 if text == 'MHz' else number:.7g}" for number in np.ravel(value))
    return " ".join(words[:-1] if unit == "s" else words), numbers, text


_BOUNDS = {
    "vector_pitch_mm": (0.005, 5.0),
    "sample_spacing_mm": (0.0005, 5.0),
    "first_sample_depth_mm": (-50.0, 400.0),
    "depth_mm": (0.0, 1000.0),
    "sampling_rate_hz": (2e5, 2e9),
    "centre_frequency_hz": (1e5, 3e8),
    "speed_of_sound_m_s": (300.0, 5000.0),
    "frame_interval_s": (1e-4, 20.0),
}
"""Lowest and highest, well beyond what scanners have; hands are imaged 5 to 100 times a second."""


def require_plausible(sweep: Sweep) -> None:
    """Refuse a sweep with a number that no scanner has.

    Raises
    ------
    InvalidInputError
        Naming the number, and that its unit may be another.
    """
    numbers = {name: getattr(sweep.grid, name, getattr(sweep.signal, name, None)) for name in _BOUNDS}
    if len(sweep) > 1:
        numbers["frame_interval_s"] = float(np.median(np.diff(sweep.frame_time_s)))
    for name, value in numbers.items():
        low, high = _BOUNDS[name]
        if value is not None and not low <= value <= high:
            raise InvalidInputError(
                f"{name}: expected {low:g} to {high:g}, got {value:g}: is it in another unit?"
            )
