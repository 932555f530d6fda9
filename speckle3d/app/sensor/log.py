"""Readings of a log of an orientation sensor, and the orientation by them, from time zero on."""

from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

import xsens
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from xsens.fusion.field import Trust, dip_rad, field_of

COLUMNS = ("t", "x", "y", "z", "field", "dip", "heading", "half", "doubt")
NORMAL_95 = 1.96

Columns = dict[str, FloatArray]
"""By the names of `COLUMNS`: time, s; gyroscope, degrees per second; norm of the field; its dip and the
heading, degrees; half the heading's 95 % interval; norm again where the field is not believed; or NaN."""


def heading_rad(rotation: Rotation) -> FloatArray:
    """Heading about up, from north to west, without jumps."""
    matrices = rotation.as_matrix().reshape(-1, 3, 3)
    return np.asarray(np.unwrap(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])))


def angles(rotation: Rotation) -> tuple[str, str]:
    """Name and value of roll, pitch and yaw."""
    return "roll, pitch, yaw", ", ".join(
        f"{angle:+.1f}°" for angle in rotation.as_euler("ZYX", degrees=True)[::-1]
    )


class LogReadings:
    """Readings and orientation of a log, computed once for all viewers.

    Parameters
    ----------
    log : ImuLog
    """

    is_live = False

    def __init__(self, log: xsens.ImuLog) -> None:
        self._log = log
        self._start_s = float(log.time_s[0])

    @cached_property
    def _orientation(self) -> xsens.Orientation | str:
        """Orientation by the readings, or why they tell none; takes a second for ten minutes."""
        try:
            return xsens.orient(self._log)
        except (InvalidInputError, InsufficientDataError) as error:
            return str(error)

    @cached_property
    def _stream(self) -> tuple[FloatArray, Rotation, str] | None:
        """Times on the sensor's clock, world from sensor, and whose; None where nothing tells it."""
        if isinstance(self._orientation, xsens.Orientation):
            rotations, whose = self._orientation.rotations, "found from its readings"
        elif self._log.oriented.any():
            rotations, whose = self._log.rotations(), f"the sensor's own: {self._orientation}"
        else:
            return None
        return rotations.time_s, rotations.world_from_sensor, whose

    def columns(self) -> Columns:
        """Readings at the times of the orientation, or at all where there is none."""
        log, orientation, stream = self._log, self._orientation, self._stream
        at = slice(None) if stream is None else np.searchsorted(log.time_s, stream[0] - 1e-9)
        time_s = log.time_s[at]
        columns = {name: np.full(len(time_s), np.nan) for name in COLUMNS} | {"t": time_s - self._start_s}
        if log.gyroscope_rad_s is not None:
            columns |= dict(zip("xyz", np.degrees(log.gyroscope_rad_s[at]).T, strict=True))
        field = None if log.magnetometer_au is None else log.magnetometer_au[at]
        if field is not None:
            columns["field"] = np.linalg.norm(field, axis=1)
        if stream is None:
            return columns
        columns["heading"] = np.degrees(heading_rad(stream[1]))
        if field is not None:
            rows = np.flatnonzero(np.isfinite(field).all(axis=1))
            columns["dip"][rows] = np.degrees(dip_rad(stream[1][rows].apply(field[rows])))
        if isinstance(orientation, xsens.Orientation):
            columns["half"] = NORMAL_95 * np.degrees(orientation.standard_deviation_rad[:, 2])
            doubtful = orientation.disturbed & orientation.magnetic
            columns["doubt"] = np.where(doubtful, columns["field"], np.nan)
        return columns

    def gaps_s(self) -> list[float]:
        """When samples are missing."""
        return [float(self._log.time_s[gap.after_index] - self._start_s) for gap in self._log.gaps]

    def judgement(self) -> tuple[Trust, str]:
        """Whether the magnetometer can be trusted here, and why."""
        field, orientation = self._log.magnetometer_au, self._orientation
        if field is None or not np.isfinite(field).any():
            return Trust.UNKNOWN, "The magnetometer cannot be judged here: the log has no readings of one."
        if isinstance(orientation, str):
            return Trust.UNKNOWN, f"The magnetometer cannot be judged here: {orientation}."
        judgement = field_of(self._log, orientation)
        return judgement.trust, judgement.sentence()

    def orientation_at(self, time_s: float) -> Rotation | None:
        """World from sensor at a time from zero; the nearest before and after the stream."""
        if self._stream is None:
            return None
        times, rotations, _ = self._stream
        if len(times) < 2:
            return rotations[0]
        return Slerp(times, rotations)(float(np.clip(time_s + self._start_s, times[0], times[-1])))

    def facts(self, time_s: float) -> list[tuple[str, str]]:
        """Facts about the log and the orientation at a time."""
        log, orientation, rotation = self._log, self._orientation, self.orientation_at(time_s)
        rows = [("time", f"{time_s:.1f} s"), *([] if rotation is None else [angles(rotation)])]
        north, notes = "magnetic north, y west", log.notes
        if isinstance(orientation, xsens.Orientation):
            times_s, last = orientation.rotations.time_s, len(orientation) - 1
            at = min(int(np.searchsorted(times_s, time_s + self._start_s)), last)
            *inclination, heading = NORMAL_95 * np.degrees(orientation.standard_deviation_rad[at])
            rows.append(("known to (95 %)", f"inclination {max(inclination):.1f}°, heading {heading:.1f}°"))
            north = north if orientation.magnetic else "where it was at the start, y to its left"
            notes = (*notes, *orientation.notes)
        origin = "none: neither its own nor by its readings" if self._stream is None else self._stream[2]
        return [
            *rows,
            ("log", f"{len(log)} samples, {log.duration_s:.1f} s, {log.rate_hz:.1f} per second"),
            ("gaps", log.losses or "none"),
            ("orientation", origin),
            ("world", f"x {north}, z up"),
            *(("note", text) for text in notes),
        ]
