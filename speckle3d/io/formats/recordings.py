"""What a recording of another's format says of its frames, and the sweep made of it.

A number comes from the file, from options, or, where all scanners have the same, is assumed; each is told
with where it comes from. What is in none of these is asked for, all at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.printable import printable
from speckle3d.core.sweep import BModeSettings, Frames, ImageGrid, RFSettings, Sweep, Tracker
from speckle3d.io.found import ASSUMED, Found, contradictions, rows_of
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.readers import Row

SPREAD = 1e-3
"""How far steps of an axis may be from their mean, as a share: rounding of single precision in metres."""


@dataclass(frozen=True)
class Recording:
    """Frames of a recording and what it says of them.

    Attributes
    ----------
    frames : Frames
        uint8 for B-mode, real for RF, complex for I/Q.
    found : mapping
        By the name of a setting, what the file says of it.
    sample_spacing_mm : float, optional
        Of RF and I/Q whose samples' depths the file gives, in place of a sampling rate.
    time_s : ndarray, shape (n,), optional
        By default of the frame rate, from 0.
    notes : sequence of rows
        What else is to be told of it.
    """

    path: Path
    frames: Frames
    found: Mapping[str, Found]
    sample_spacing_mm: float | None = None
    time_s: FloatArray | None = None
    tracker: Tracker | None = None
    probe: str = ""
    notes: tuple[Row, ...] = field(default=())

    def sweep(self, settings: ImportSettings) -> Sweep:
        """Make the sweep.

        Raises
        ------
        MissingSettingsError
            Naming all that neither the recording nor the settings give.
        InvalidInputError
            If the numbers cannot be those of echoes.
        """
        if 0 in self.frames.shape:
            raise InvalidInputError(f"{self.path}: expected frames, got shape {self.frames.shape}")
        values = settings.over(self.path, **{n: one.value for n, one in self._needed(settings).items()})
        with naming(str(self.path)):
            self._require_depths(values)
            signal = self._signal(values)
            pitch = values["vector_pitch_mm" if isinstance(signal, RFSettings) else "column_pitch_mm"]
            spacing = signal.sample_spacing_mm if isinstance(signal, RFSettings) else values["row_spacing_mm"]
            return Sweep(
                frames=self.frames,
                grid=ImageGrid(*self.frames.shape[1:], pitch, spacing, values["first_sample_depth_mm"]),
                signal=signal,
                frame_time_s=self._times(values),
                tracker=self.tracker,
                name=printable(self.path.name.split(".")[0]),
                probe=self.probe,
            )

    def rows(self, settings: ImportSettings) -> list[Row]:
        """Tell what each number is and where it comes from."""
        return [*self.notes, *rows_of(self.path, self._needed(settings), settings)]

    def contradictions(self, settings: ImportSettings) -> list[str]:
        """Tell what is given and is another than the recording says."""
        return contradictions(self.path, self._needed(settings), settings)

    def _needed(self, settings: ImportSettings) -> dict[str, Found]:
        names = ["first_sample_depth_mm"]
        if self.frames.dtype == np.uint8:
            names += ["column_pitch_mm", "row_spacing_mm", "dynamic_range_db"]
        else:
            names += ["vector_pitch_mm", "speed_of_sound_m_s", "sampling_rate_hz", "centre_frequency_hz"]
            names += ["bandwidth_hz"]
        if self.frames.dtype.kind == "c":
            names.append("demodulation_frequency_hz")
        if self.frames.shape[0] > 1 and (self.time_s is None or settings.frame_rate_hz is not None):
            names.append("frame_rate_hz")
        needed = {name: self.found.get(name, ASSUMED.get(name, Found())) for name in names}
        if "frame_rate_hz" in needed and self.time_s is not None:
            needed["frame_rate_hz"] = Found(rate_of(self.time_s), "of its times")
        if "sampling_rate_hz" in needed and self.sample_spacing_mm is not None:
            speed = settings.speed_of_sound_m_s or needed["speed_of_sound_m_s"].value
            needed["sampling_rate_hz"] = Found(
                1e3 * speed / (2.0 * self.sample_spacing_mm),
                f"of samples {self.sample_spacing_mm:.6g} mm apart at {speed:g} m/s",
            )
        return needed

    def _require_depths(self, values: Mapping[str, Any]) -> None:
        """Refuse a sampling rate that contradicts where the recording says its samples lie."""
        rate, spacing = values.get("sampling_rate_hz"), self.sample_spacing_mm
        if rate is None or spacing is None:
            return
        speed = values["speed_of_sound_m_s"]
        implied = 1e3 * speed / (2.0 * spacing)
        if abs(rate - implied) > SPREAD * implied:
            raise InvalidInputError(
                f"sampling_rate_hz: expected {implied:.7g} of samples that lie {spacing:.6g} mm apart at "
                f"{speed:g} m/s, got {rate:.7g}"
            )

    def _signal(self, values: Mapping[str, Any]) -> RFSettings | BModeSettings:
        if self.frames.dtype == np.uint8:
            return BModeSettings(values["dynamic_range_db"])
        return RFSettings(
            values["sampling_rate_hz"],
            values["speed_of_sound_m_s"],
            values["centre_frequency_hz"],
            tuple(values["bandwidth_hz"]),
            values.get("demodulation_frequency_hz"),
        )

    def _times(self, values: Mapping[str, Any]) -> FloatArray:
        rate = values.get("frame_rate_hz")
        if rate is None:
            return np.zeros(1) if self.time_s is None else self.time_s
        return np.arange(self.frames.shape[0]) / float(rate)


def rate_of(time_s: FloatArray) -> float | None:
    """Mean frame rate of times, Hz; None of fewer than two, or where they do not rise."""
    span = float(time_s[-1] - time_s[0]) if time_s.size > 1 else 0.0
    return (time_s.size - 1) / span if span > 0 else None


def step_of(axis: FloatArray, where: str) -> float:
    """Distance between neighbours of an axis.

    Raises
    ------
    InvalidInputError
        If it does not rise in even steps, or has fewer than two values.
    """
    if axis.size < 2 or not np.isfinite(axis).all():
        raise InvalidInputError(f"{where}: expected at least two finite positions, got {axis.size}")
    step = float(axis[-1] - axis[0]) / (axis.size - 1)
    steps = np.diff(axis)
    if not step > 0:
        raise InvalidInputError(f"{where}: expected rising positions, got {axis[0]:g} to {axis[-1]:g}")
    # Single precision far from zero rounds to a share of the position, not of the step.
    allowed = SPREAD * step + 4e-7 * float(np.abs(axis).max())
    if np.abs(steps - step).max() > allowed:
        worst = int(np.argmax(np.abs(steps - step)))
        raise InvalidInputError(f"{where}[{worst}]: expected even steps of {step:g}, got {steps[worst]:g}")
    return step
