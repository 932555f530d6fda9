"""Steps that all readers of logs share: hints, the sensor's own orientation, and assembly of an `ImuLog`.

The world of an orientation is x magnetic north, y west, z up (NWU). Quaternions are scalar first and take the
sensor's axes to the world's; angles are roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from xsens.logs.clocks import Stamps, Timeline, require_rate, timeline
from xsens.logs.faults import measured
from xsens.logs.samples import ImuLog
from xsens.logs.worlds import Claim, nwu_from, settle, turned, upright_part

_WORST_NORM = 0.05
"""How far a quaternion's length may be from 1, and a matrix's rows from orthonormal: far beyond rounding in
any number format (1e-6), far below the effect of damage."""

_WORST_ANGLE_DEG = 720.0

_CLEARLY_LESS = 0.25
"""Ratio of what misses to upright, by which columns must be better than rows: half the angle."""


@dataclass(frozen=True)
class Hints:
    """Facts known beside the log; each outweighs what the log says.

    Attributes
    ----------
    rate_hz : float, optional
        Samples per second, for logs with a counter but no clock.
    world : str, optional
        Of the sensor's own orientation, ENU, NED or NWU.
    as_stated : bool
        Take the world that the log states or its program's default, whatever its readings show: too few
        samples of a live stream show nothing.

    Raises
    ------
    InvalidInputError
        If no sensor has such a rate, or there is no such world.
    """

    rate_hz: float | None = None
    world: str | None = None
    as_stated: bool = False

    def __post_init__(self) -> None:
        if self.rate_hz is not None:
            require_rate(self.rate_hz, "rate_hz")
        if self.world is not None:
            nwu_from(self.world)


@dataclass(frozen=True)
class Parts:
    """Samples before their clock is known: as in `ImuLog`, one row for each message or line.

    `vectors` are the readings of accelerometer, gyroscope and magnetometer, those named in `increments` times
    the sampling period; `orientations` the sensor's own, meaningless where `there` is false.
    """

    source: str
    notes: tuple[str, ...] = ()
    vectors: tuple[FloatArray | None, ...] = (None, None, None)
    orientations: Rotation | None = None
    there: BoolArray | None = None
    increments: tuple[str, ...] = ()

    def noting(self, *notes: str) -> Parts:
        """The same parts with more notes."""
        return replace(self, notes=(*self.notes, *notes))


def only(values: Any, kept: BoolArray) -> Any:
    """`values[kept]` of an array or Rotation, without a copy if all are kept; None stays None."""
    return values if values is None or kept.all() else values[kept]


# -- from parts to a log


def on_clock(stamps: Stamps, samples: int, parts: Parts, hints: Hints) -> ImuLog:
    """Build the log of samples that have a clock, or a counter and a rate, or a rate alone.

    Raises
    ------
    InvalidInputError
        If they have none of these.
    """
    if hints.rate_hz is not None:
        stamps = replace(stamps, period_s=1.0 / hints.rate_hz)
    counted = stamps.counter is not None or stamps.ticks is not None
    if not counted and stamps.period_s > 0.0:
        stamps = replace(stamps, counter=np.arange(samples), counter_span=1 << 62)
        parts = parts.noting("samples have no counter: losses cannot be found")
    log = assembled(timeline(stamps), parts)
    changed: dict[str, Any] = {} if counted else {"counter": None}
    for name in parts.increments:
        values = getattr(log, name)
        changed[name] = None if values is None else values * log.rate_hz
    return replace(log, **changed) if changed else log


def assembled(line: Timeline, parts: Parts) -> ImuLog:
    """Build the log of the samples that the timeline keeps."""
    there = None if parts.there is None or not parts.there.any() else parts.there
    notes = list(parts.notes)
    if parts.there is not None and not parts.there.all():
        notes.append(f"{int((~parts.there).sum())} samples lack the sensor's own orientation")
    force, rate, field = (_at(rows, line.rows) for rows in parts.vectors)
    log = ImuLog(
        line.time_s,
        force,
        rate,
        field,
        None if there is None else _at(parts.orientations, line.rows),
        line.counter,
        line.gaps,
        (*notes, *line.notes),
        parts.source,
        np.zeros(0, dtype=bool) if there is None else _at(there, line.rows),
    )
    return measured(log)


def _at(values: Any, rows: IntArray | None) -> Any:
    """Rows of an array or Rotation; all, without a copy, if `rows` is None."""
    return values if values is None or rows is None else values[rows]


# -- the sensor's own orientation


def oriented(
    parts: Parts,
    claim: Claim,
    hints: Hints,
    quaternions: FloatArray | None = None,
    matrices: FloatArray | None = None,
    angles_deg: FloatArray | None = None,
) -> Parts:
    """Add the sensor's own orientation from the first notation that is there.

    Parameters
    ----------
    parts : Parts
        Their accelerometer and magnetometer show the world, and whether matrices were written by rows.
    claim : Claim
        World as stated.
    hints : Hints
    quaternions : ndarray, shape (m, 4), optional
        Those that are not of unit length count as missing.
    matrices : ndarray, shape (m, 9), optional
        Row after row.
    angles_deg : ndarray, shape (m, 3), optional
    """
    wxyz, acceleration, field = quaternions, parts.vectors[0], parts.vectors[2]
    if wxyz is None and matrices is not None:
        wxyz, by_columns = _of_matrices(matrices, acceleration)
        if by_columns:
            parts = parts.noting("matrices were taken by columns: so they turn gravity upright")
    elif wxyz is None and angles_deg is not None:
        wxyz = _of_angles(angles_deg)
    if wxyz is None:
        return parts
    there = of_unit_length(wxyz)
    if hints.world is not None:
        claim = Claim(hints.world, "as given", final=True)
    world = claim.world.upper()
    if not hints.as_stated and there.any():
        world, told = settle(claim, *(only(rows, there) for rows in (wxyz, acceleration, field)))
        parts = parts.noting(*told)
    return replace(parts, orientations=_seen_from_north(wxyz, there, world), there=there)


def of_unit_length(wxyz: FloatArray) -> BoolArray:
    """Mark quaternions, shape (m, 4), that are no damage."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.abs(np.sqrt(np.einsum("ij,ij->i", wxyz, wxyz)) - 1.0) < _WORST_NORM)


def are_rotations(matrices: FloatArray) -> BoolArray:
    """Mark the matrices, shape (m, 3, 3), that have orthonormal rows and are right-handed."""
    finite = np.where(np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None, None] < 2.0, matrices, 0.0)
    off = np.abs(np.einsum("mij,mkj->mik", finite, finite) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    return np.asarray((off < _WORST_NORM) & (np.linalg.det(finite) > 0.0))


def _of_matrices(matrices: FloatArray, acceleration: FloatArray | None) -> tuple[FloatArray, bool]:
    """Quaternions of matrices, and whether they were written by columns, as the acceleration shows."""
    by_rows = _quaternions(matrices)
    by_columns = _quaternions(matrices.reshape(-1, 3, 3).swapaxes(1, 2))
    missing = [1.0 - abs(upright_part(each, acceleration) or 0.0) for each in (by_rows, by_columns)]
    clearly = missing[1] < _CLEARLY_LESS * missing[0]
    return by_columns if clearly else by_rows, clearly


def _of_angles(angles_deg: FloatArray) -> FloatArray:
    """Quaternions of roll, pitch and yaw; NaN of those that are damage."""
    good = np.asarray((np.abs(angles_deg) <= _WORST_ANGLE_DEG).all(axis=1))
    wxyz = np.full((good.size, 4), np.nan)
    if good.any():
        turns = Rotation.from_euler("xyz", angles_deg[good], degrees=True)
        wxyz[good] = turns.as_quat(scalar_first=True)
    return wxyz


def _quaternions(matrices: FloatArray) -> FloatArray:
    """Quaternions of matrices, row after row; NaN of those that are no rotations."""
    matrices = matrices.reshape(-1, 3, 3)
    good = are_rotations(matrices)
    wxyz = np.full((good.size, 4), np.nan)
    if good.any():
        wxyz[good] = Rotation.from_matrix(matrices[good]).as_quat(scalar_first=True)
    return wxyz


def _seen_from_north(wxyz: FloatArray, there: BoolArray, world: str) -> Rotation:
    """``nwu_from_world`` times the rotations; the identity where there is none."""
    xyzw = turned(nwu_from(world), wxyz)
    if not there.all():
        xyzw[~there] = [0.0, 0.0, 0.0, 1.0]
    return Rotation.from_quat(xyzw)
