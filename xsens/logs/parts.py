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
from xsens.logs.clocks import Stamps, Timeline, require_rate, timeline
from xsens.logs.samples import VECTORS, ImuLog
from xsens.logs.worlds import Claim, nwu_from, settle
from xsens.messages.rawcounts import RawCalibration

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
    calibration : RawCalibration, optional
        Of raw counts without their calibration block, from another log of the same unit.
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
    calibration: RawCalibration | None = None
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

    `vectors` are the readings of accelerometer, gyroscope and magnetometer; `orientations` the sensor's own,
    meaningless where `there` is false.
    """

    source: str
    notes: tuple[str, ...] = ()
    vectors: tuple[FloatArray | None, ...] = (None, None, None)
    orientations: Rotation | None = None
    there: BoolArray | None = None

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
    counted = stamps.counter is not None or stamps.ticks is not None
    if not counted and stamps.period_s > 0.0:
        stamps = replace(stamps, counter=np.arange(samples), counter_span=1 << 62)
    line = timeline(stamps)
    if counted:
        del stamps
        return assembled(line, parts())
    note = "samples have no counter: losses cannot be found"
    return replace(assembled(line, parts().noting(note)), counter=None)


def assembled(line: Timeline, parts: Parts) -> ImuLog:
    """Build the log of the samples that the timeline keeps."""
    missing = 0 if parts.there is None else int((~parts.there).sum())
    lacking = (f"{missing} samples lack the sensor's own orientation",) if missing else ()
    oriented = parts.there is not None and bool(parts.there.any())
    sane = [_sane(only(vectors, line.kept)) for vectors in parts.vectors]
    absurd = tuple(
        f"{wrong} {name.split('_')[0]} readings out of range were left out"
        for name, (_, wrong) in zip(VECTORS, sane, strict=True)
        if wrong
    )
    return ImuLog(
        line.time_s,
        sane[0][0],
        sane[1][0],
        sane[2][0],
        only(parts.orientations, line.kept) if oriented else None,
        line.counter,
        line.gaps,
        (*parts.notes, *absurd, *lacking, *line.notes),
        parts.source,
        parts.there[line.kept] if parts.there is not None and oriented else np.zeros(0, dtype=bool),
    )


def _sane(rows: FloatArray | None) -> tuple[FloatArray | None, int]:
    """Rows, NaN where they cannot be a measurement, None if none can; and how many are absurd numbers."""
    if rows is None or (
        rows.max(initial=0.0) < _ABSURD and rows.min(initial=0.0) > -_ABSURD
    ):  # no NaN either
        return rows, 0
    good = np.asarray((np.abs(rows) < _ABSURD).all(axis=1))
    wrong = int((np.abs(rows) >= _ABSURD).any(axis=1).sum())
    return (np.where(good[:, None], rows, np.nan) if good.any() else None), wrong


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
    wxyz = quaternions
    notes: tuple[str, ...] = ()
    if wxyz is None and matrices is not None:
        by_rows, notes = _rows_or_columns(matrices.reshape(-1, 3, 3), parts.vectors[0])
        wxyz = _or_nan(are_rotations(by_rows), lambda there: Rotation.from_matrix(by_rows[there]))
    elif wxyz is None and angles_deg is not None:
        good = np.asarray((np.abs(angles_deg) <= _WORST_ANGLE_DEG).all(axis=1))
        wxyz = _or_nan(good, lambda there: Rotation.from_euler("xyz", angles_deg[there], degrees=True))
    if wxyz is None:
        return parts
    with np.errstate(over="ignore", invalid="ignore"):
        there = np.asarray(np.abs(np.sqrt(np.einsum("ij,ij->i", wxyz, wxyz)) - 1.0) < _WORST_NORM)
    if hints.world is not None:
        claim = Claim(hints.world, "as given", final=True)
    world = claim.world.upper()
    if not hints.as_stated and there.any():
        world, told = settle(claim, wxyz[there] if not there.all() else wxyz, *_where(there, parts))
        notes = (*notes, *told)
    return replace(parts.noting(*notes), orientations=_seen_from_north(wxyz, there, world), there=there)


def _where(there: BoolArray, parts: Parts) -> tuple[FloatArray | None, FloatArray | None]:
    return only(parts.vectors[0], there), only(parts.vectors[2], there)


def _or_nan(there: BoolArray, rotations: Callable[[BoolArray], Rotation]) -> FloatArray:
    """Quaternions of the rotations that are there, scalar first; NaN elsewhere."""
    wxyz = np.full((there.size, 4), np.nan)
    if there.any():
        wxyz[there] = rotations(there).as_quat(scalar_first=True)
    return wxyz


def are_rotations(matrices: FloatArray) -> BoolArray:
    """Mark the matrices, shape (m, 3, 3), that have orthonormal rows and are right-handed."""
    finite = np.where(np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None, None] < 2.0, matrices, 0.0)
    off = np.abs(np.einsum("mij,mkj->mik", finite, finite) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    return np.asarray((off < _WORST_NORM) & (np.linalg.det(finite) > 0.0))


def _rows_or_columns(
    matrices: FloatArray, accelerometer_m_s2: FloatArray | None
) -> tuple[FloatArray, tuple[str, ...]]:
    """The matrices or their transposes: those that turn the acceleration at rest upright; a note if so."""
    if accelerometer_m_s2 is None:
        return matrices, ()
    with np.errstate(over="ignore", invalid="ignore"):
        rest = np.abs(np.linalg.norm(accelerometer_m_s2, axis=1) - g) < _AT_REST_M_S2
    rest &= are_rotations(matrices)
    as_is, turned = (
        np.linalg.norm(np.abs(np.einsum(how, matrices[rest], accelerometer_m_s2[rest])) - [0, 0, g], axis=1)
        for how in ("mij,mj->mi", "mji,mj->mi")
    )
    if rest.any() and np.median(turned) < _CLEARLY_BETTER * np.median(as_is):
        return np.swapaxes(matrices, 1, 2), ("matrices were taken by columns: so they turn gravity upright",)
    return matrices, ()


def _seen_from_north(wxyz: FloatArray, there: BoolArray, world: str) -> Rotation:
    """``nwu_from_world`` times the rotations, as one product of matrices: many times faster than SciPy's."""
    w, x, y, z = nwu_from(world).as_quat(scalar_first=True)
    product = np.array([[x, w, -z, y], [y, z, w, -x], [z, -y, x, w], [w, -x, -y, -z]])
    xyzw = np.einsum("ij,mj->mi", product, wxyz)
    if not there.all():
        xyzw[~there] = [0.0, 0.0, 0.0, 1.0]
    return Rotation.from_quat(xyzw)
