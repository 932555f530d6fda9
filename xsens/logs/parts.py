"""Steps that all readers of logs share: hints, the sensor's own orientation, and assembly of an `ImuLog`.

The world of an orientation is x magnetic north, y west, z up (NWU). Quaternions are scalar first and take the
sensor's axes to the world's; angles are roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.constants import g
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps, Timeline, timeline
from xsens.logs.samples import ImuLog
from xsens.messages.mtdata import DataLayout
from xsens.messages.rawcounts import RawCalibration

WORLDS = {
    "NWU": Rotation.identity(),
    "ENU": Rotation.from_euler("z", -90.0, degrees=True),
    "NED": Rotation.from_euler("x", 180.0, degrees=True),
}
"""``nwu_from_world`` of each world that the sensors know."""

_ABSURD = 1e6
"""Larger values, in any of the units, are damage: the sensors' ranges end at 160 m/s² and 35 rad/s."""

_WORST_NORM = 0.05
"""How far a quaternion's length may be from 1, and a matrix's rows from orthonormal: far beyond rounding in
any number format (1e-6), far below the effect of damage."""

_WORST_ANGLE_DEG = 720.0

_AT_REST_M_S2 = 0.5
"""How far from gravity an acceleration may be and still show where up is."""

_CLEARLY_BETTER = 0.5


@dataclass(frozen=True)
class Hints:
    """Facts known beside the log; each outweighs what the log says.

    Attributes
    ----------
    rate_hz : float, optional
        Samples per second, for logs with a counter but no clock.
    layout : DataLayout, optional
        Of legacy data messages without their configuration.
    calibration : RawCalibration, optional
        Of raw counts without their calibration block, from another log of the same unit.
    world : str, optional
        Of the sensor's own orientation, ENU, NED or NWU, if the log does not name it.
    unit : int, optional
        Which of several units behind a master, from 0.

    Raises
    ------
    InvalidInputError
        If the rate is not positive.
    """

    rate_hz: float | None = None
    layout: DataLayout | None = None
    calibration: RawCalibration | None = None
    world: str | None = None
    unit: int | None = None

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 0.0 < self.rate_hz < float("inf"):
            raise InvalidInputError(f"rate_hz: expected a number above 0, got {self.rate_hz:g}")


@dataclass(frozen=True)
class Orientations:
    """The sensor's own orientation of every sample; some samples may lack it.

    Attributes
    ----------
    world_from_sensor : Rotation, length m
        The identity where `there` is false.
    there : ndarray of bool, shape (m,)
    """

    world_from_sensor: Rotation
    there: BoolArray


@dataclass(frozen=True)
class Parts:
    """Samples before their clock is known: as in `ImuLog`, one row for each message or line.

    `vectors` are the readings of accelerometer, gyroscope and magnetometer.
    """

    source: str
    notes: tuple[str, ...] = ()
    vectors: tuple[FloatArray | None, ...] = (None, None, None)
    orientations: Orientations | None = None

    def noting(self, *notes: str) -> Parts:
        """The same parts with more notes."""
        return replace(self, notes=(*self.notes, *notes))


def only(values: Any, kept: BoolArray) -> Any:
    """`values[kept]` of an array or Rotation, without a copy if all are kept; None stays None."""
    return values if values is None or kept.all() else values[kept]


# -- from parts to a log


def on_clock(stamps: Stamps, samples: int, parts: Callable[[], Parts], hints: Hints) -> ImuLog:
    """Build the log of samples that have a clock, or a counter and a rate, or a rate alone.

    Parameters
    ----------
    parts : callable
        Returns the samples' parts. It is called once their times are known: finding those takes as much
        memory meanwhile as the parts do.

    Raises
    ------
    InvalidInputError
        If they have none of these.
    """
    if hints.rate_hz is not None:
        stamps = replace(stamps, period_s=1.0 / hints.rate_hz)
    if stamps.counter is not None or stamps.ticks is not None:
        line = timeline(stamps)
        del stamps
        return assembled(line, parts())
    if hints.rate_hz is None:
        raise InvalidInputError("expected samples with a clock or a counter, or a sampling rate, got neither")
    line = timeline(replace(stamps, counter=np.arange(samples)))
    note = "samples have no counter: losses cannot be found"
    return replace(assembled(line, parts().noting(note)), counter=None)


def assembled(line: Timeline, parts: Parts) -> ImuLog:
    """Build the log of the samples that the timeline keeps."""
    turned = parts.orientations
    missing = 0 if turned is None else int((~turned.there).sum())
    lacking = (f"{missing} samples lack the sensor's own orientation",) if missing else ()
    oriented = turned is not None and bool(turned.there.any())
    acceleration, rate, field = (_sane(vectors, line.kept) for vectors in parts.vectors)
    return ImuLog(
        line.time_s,
        acceleration,
        rate,
        field,
        only(turned.world_from_sensor, line.kept) if turned is not None and oriented else None,
        line.counter,
        line.gaps,
        (*parts.notes, *_out_of_range(parts, line.kept), *lacking, *line.notes),
        parts.source,
        turned.there[line.kept] if turned is not None and oriented else np.zeros(0, dtype=bool),
    )


def _out_of_range(parts: Parts, kept: BoolArray) -> tuple[str, ...]:
    """Notes of readings that `_sane` leaves out although they are numbers."""
    notes = []
    for name, vectors in zip(("accelerometer", "gyroscope", "magnetometer"), parts.vectors, strict=True):
        if vectors is None or _within(vectors):
            continue
        if count := int((np.abs(vectors[kept]) >= _ABSURD).any(axis=1).sum()):
            notes.append(f"{count} {name} readings out of range were left out")
    return tuple(notes)


def _sane(vectors: FloatArray | None, kept: BoolArray) -> FloatArray | None:
    """Kept rows, NaN where they cannot be a measurement; None if none can."""
    rows: FloatArray | None = only(vectors, kept)
    if rows is None or _within(rows):
        return rows
    good = np.asarray((np.abs(rows) < _ABSURD).all(axis=1))
    return np.where(good[:, None], rows, np.nan) if good.any() else None


def _within(rows: FloatArray) -> bool:
    """Whether all are numbers that may be a measurement; without a copy of them."""
    return bool(rows.max(initial=0.0) < _ABSURD and rows.min(initial=0.0) > -_ABSURD)  # false for a NaN


# -- the sensor's own orientation


def nwu_from(world: str) -> Rotation:
    """Rotation from a world by name; raises `InvalidInputError` if there is none of that name."""
    if world.upper() not in WORLDS:
        raise InvalidInputError(f"world: expected {', '.join(WORLDS)}, got {world!r}")
    return WORLDS[world.upper()]


def orientations_of(
    world: str,
    accelerometer_m_s2: FloatArray | None,
    quaternions: FloatArray | None = None,
    matrices: FloatArray | None = None,
    angles_deg: FloatArray | None = None,
) -> tuple[Orientations | None, tuple[str, ...]]:
    """The sensor's own orientation from the first notation that is there, and notes on it.

    Parameters
    ----------
    world : str
        ENU, NED or NWU.
    accelerometer_m_s2 : ndarray, shape (m, 3), or None
        Tells whether matrices were written by rows or by columns.
    quaternions : ndarray, shape (m, 4), optional
    matrices : ndarray, shape (m, 9), optional
        Row after row.
    angles_deg : ndarray, shape (m, 3), optional
    """
    if quaternions is not None:
        return from_quaternions(quaternions, world), ()
    if matrices is not None:
        by_rows, turned = _rows_or_columns(matrices.reshape(-1, 3, 3), accelerometer_m_s2)
        note = "matrices were taken by columns: so they turn gravity upright"
        return _from_matrices(by_rows, world), ((note,) if turned else ())
    return (None if angles_deg is None else from_angles(angles_deg, world)), ()


def from_quaternions(wxyz: FloatArray, world: str) -> Orientations:
    """Orientations of quaternions, shape (m, 4); those that are not of unit length count as missing."""
    there = np.asarray(np.abs(_length(wxyz) - 1.0) < _WORST_NORM)
    usable = wxyz if there.all() else np.where(there[:, None], wxyz, [1.0, 0.0, 0.0, 0.0])
    return _seen_from_north(usable, there, world)


def from_angles(roll_pitch_yaw_deg: FloatArray, world: str) -> Orientations:
    """Orientations of angles in degrees, shape (m, 3)."""
    there = np.asarray((np.abs(roll_pitch_yaw_deg) <= _WORST_ANGLE_DEG).all(axis=1))
    usable = np.where(there[:, None], roll_pitch_yaw_deg, 0.0)
    quaternions = Rotation.from_euler("xyz", usable, degrees=True).as_quat(scalar_first=True)
    return _seen_from_north(quaternions, there, world)


def _from_matrices(matrices: FloatArray, world: str) -> Orientations:
    """Orientations of matrices, shape (m, 3, 3); those that are not rotations count as missing."""
    there = are_rotations(matrices)
    usable = np.where(there[:, None, None], matrices, np.eye(3))
    return _seen_from_north(Rotation.from_matrix(usable).as_quat(scalar_first=True), there, world)


def are_rotations(matrices: FloatArray) -> BoolArray:
    """Mark the matrices, shape (m, 3, 3), that have orthonormal rows and are right-handed."""
    finite = np.where(np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None, None] < 2.0, matrices, 0.0)
    off = np.abs(np.einsum("mij,mkj->mik", finite, finite) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    return np.asarray((off < _WORST_NORM) & (np.linalg.det(finite) > 0.0))


def _rows_or_columns(matrices: FloatArray, accelerometer_m_s2: FloatArray | None) -> tuple[FloatArray, bool]:
    """Choose the matrices or their transposes: those that turn the acceleration at rest straight up.

    Returns
    -------
    ndarray, shape (m, 3, 3)
    bool
        Whether they were transposed; never without samples at rest.
    """
    if accelerometer_m_s2 is None:
        return matrices, False
    rest = np.abs(_length(accelerometer_m_s2) - g) < _AT_REST_M_S2
    rest &= are_rotations(matrices)
    as_is, turned = (
        np.linalg.norm(np.einsum(how, matrices[rest], accelerometer_m_s2[rest]) - [0, 0, g], axis=1)
        for how in ("mij,mj->mi", "mji,mj->mi")
    )
    if rest.any() and np.median(turned) < _CLEARLY_BETTER * np.median(as_is):
        return np.swapaxes(matrices, 1, 2), True
    return matrices, False


def _length(vectors: FloatArray) -> FloatArray:
    with np.errstate(over="ignore"):
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def _seen_from_north(wxyz: FloatArray, there: BoolArray, world: str) -> Orientations:
    """``nwu_from_world`` times the rotations, as one product of matrices: many times faster than SciPy's."""
    w, x, y, z = nwu_from(world).as_quat(scalar_first=True)
    product = np.array([[x, w, -z, y], [y, z, w, -x], [z, -y, x, w], [w, -x, -y, -z]])
    xyzw = np.einsum("ij,mj->mi", product, wxyz)
    if not there.all():
        xyzw[~there] = [0.0, 0.0, 0.0, 1.0]
    return Orientations(Rotation.from_quat(xyzw), there)
