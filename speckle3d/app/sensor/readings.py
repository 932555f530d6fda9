"""What there is to see of a sensor's log: readings, orientation, field, losses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from xsens.fusion.field import FieldFound, Trust, dip_rad, field_of
from xsens.fusion.orient import Orientation, orient
from xsens.logs.samples import ImuLog

_NORMAL_95 = 1.96


class Trace(NamedTuple):
    """One line of a plot."""

    name: str
    time_s: FloatArray
    values: FloatArray


@dataclass(frozen=True)
class Readings:
    """A log on its own clock, from zero, with what was found of it.

    Attributes
    ----------
    log : ImuLog
    found : Orientation or None
        None where the log's readings do not tell an orientation.
    why_not : str
        Why there is none.
    field : FieldFound or None
    """

    log: ImuLog
    found: Orientation | None
    why_not: str
    field: FieldFound | None

    @classmethod
    def of(cls, log: ImuLog) -> Readings:
        """Find the orientation of a log and what it tells of the field; takes a second for ten minutes."""
        try:
            found = orient(log)
        except (InvalidInputError, InsufficientDataError) as error:
            return cls(log, None, str(error), None)
        return cls(log, found, "", field_of(log, found))

    @property
    def start_s(self) -> float:
        """Time of the first sample on the sensor's clock."""
        return float(self.log.time_s[0])

    @property
    def trust(self) -> Trust:
        """How far the magnetometer can be trusted."""
        return Trust.UNKNOWN if self.field is None else self.field.trust

    def sentence(self) -> str:
        """Whether the magnetometer can be trusted here, and why."""
        if self.log.magnetometer_au is None or not np.isfinite(self.log.magnetometer_au).any():
            return "The magnetometer cannot be judged here: the log has no readings of one."
        if self.field is None:
            return f"The magnetometer cannot be judged here: {self.why_not}."
        return self.field.sentence()

    def rotations(self) -> tuple[FloatArray, Rotation, str] | None:
        """Times from zero, world from sensor, and whose; None where nothing tells it."""
        if self.found is not None:
            stream, whose = self.found.rotations, "found from its readings"
        elif self.log.oriented.any():
            stream, whose = self.log.rotations(), "the sensor's own"
        else:
            return None
        return stream.time_s - self.start_s, stream.world_from_sensor, whose

    def orientation_at(self, time_s: float) -> Rotation | None:
        """World from sensor at a time from zero; the nearest before and after the stream."""
        stream = self.rotations()
        if stream is None:
            return None
        times, rotations, _ = stream
        if len(times) < 2:
            return rotations[0]
        after = int(np.clip(np.searchsorted(times, time_s), 1, len(times) - 1))
        pair = times[after - 1 : after + 1]
        return Slerp(pair, rotations[after - 1 : after + 1])(float(np.clip(time_s, *pair)))

    def rates(self) -> list[Trace]:
        """Gyroscope, degrees per second."""
        return self._vectors("gyroscope_rad_s", np.degrees(1.0))

    def forces(self) -> list[Trace]:
        """Accelerometer, m/s^2."""
        return self._vectors("accelerometer_m_s2", 1.0)

    def _vectors(self, name: str, factor: float) -> list[Trace]:
        values = getattr(self.log, name)
        if values is None or not np.isfinite(values).any():
            return []
        time_s = self.log.time_s - self.start_s
        return [Trace(axis, time_s, factor * values[:, k]) for k, axis in enumerate("xyz")]

    def norm(self) -> list[Trace]:
        """Norm of the field over its median."""
        field = self.log.magnetometer_au
        if field is None or not np.isfinite(field).any():
            return []
        norm = np.linalg.norm(field, axis=1)
        return [Trace("field", self.log.time_s - self.start_s, norm / np.nanmedian(norm))]

    def dip(self) -> list[Trace]:
        """Angle of the field below the horizontal, degrees, where the orientation is known."""
        stream, field = self.rotations(), self.log.magnetometer_au
        if stream is None or field is None:
            return []
        used = np.searchsorted(self.log.time_s, stream[0] + self.start_s - 1e-9)
        held = field[used]
        there = np.flatnonzero(np.isfinite(held).all(axis=1))
        if not there.size:
            return []
        dip = np.full(len(held), np.nan)
        dip[there] = np.degrees(dip_rad(stream[1][there].apply(held[there])))
        return [Trace("dip", stream[0], dip)]

    def heading(self) -> tuple[Trace, FloatArray] | None:
        """Heading about up in degrees, without jumps, and half the width of its 95 % band."""
        stream = self.rotations()
        if stream is None:
            return None
        matrices = stream[1].as_matrix()
        degrees = np.degrees(np.unwrap(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])))
        half = np.zeros(len(degrees))
        if self.found is not None:
            half = _NORMAL_95 * np.degrees(self.found.standard_deviation_rad[:, 2])
        return Trace("heading", stream[0], degrees), half

    def disbelieved(self) -> list[tuple[float, float]]:
        """Stretches of time whose field was hardly believed."""
        if self.found is None or not self.found.magnetic:
            return []
        return _stretches(self.found.rotations.time_s - self.start_s, self.found.disturbed)

    def gaps(self) -> list[tuple[float, float]]:
        """Stretches of time in which samples are missing."""
        time_s = self.log.time_s - self.start_s
        return [(float(time_s[gap.after_index]), gap.duration_s) for gap in self.log.gaps]

    def losses(self) -> str:
        """Losses in words."""
        log = self.log
        if not log.gaps:
            return "none"
        longest = max(gap.duration_s for gap in log.gaps)
        what = f"{log.lost} samples in {len(log.gaps)} gaps" if log.lost else f"{len(log.gaps)} pauses"
        return f"{what}, the longest of {longest:.3f} s"

    def world(self) -> str:
        """Which world orientations are seen from."""
        north = "magnetic north" if self.found is None or self.found.magnetic else "where it was at the start"
        return f"x {north}, y to its left, z up" if "start" in north else f"x {north}, y west, z up"

    def notes(self) -> list[str]:
        """What was skipped, assumed or missing."""
        return [*self.log.notes, *(() if self.found is None else self.found.notes)]


def _stretches(time_s: FloatArray, true: BoolArray) -> list[tuple[float, float]]:
    """Begin and end of the runs of samples that are true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], true.astype(np.int8), [0]])))
    return [(float(time_s[a]), float(time_s[b - 1])) for a, b in edges.reshape(-1, 2)]


def thinned(trace: Trace, from_s: float, until_s: float, most: int = 3000) -> tuple[FloatArray, FloatArray]:
    """Points of a trace for a plot of a range of time: all, or least and greatest of every piece."""
    first = max(int(np.searchsorted(trace.time_s, from_s)) - 1, 0)
    last = min(int(np.searchsorted(trace.time_s, until_s)) + 1, len(trace.time_s))
    time_s, values = trace.time_s[first:last], trace.values[first:last]
    width = len(values) // (most // 2)
    if width < 2:
        return time_s, values
    pieces = len(values) // width
    blocks = values[: pieces * width].reshape(pieces, width)
    low = np.where(np.isfinite(blocks), blocks, np.inf).argmin(axis=1)
    high = np.where(np.isfinite(blocks), blocks, -np.inf).argmax(axis=1)
    at = np.sort(np.column_stack([low, high]), axis=1) + width * np.arange(pieces)[:, None]
    kept = np.concatenate([at.ravel(), [len(values) - 1]])
    return time_s[kept], values[kept]
