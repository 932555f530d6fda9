"""What all readers of logs hand over: samples as they were sent; and their assembly to an `ImuLog`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps, spread, timeline
from xsens.logs.faults import without_faults
from xsens.logs.samples import VECTORS, ImuLog
from xsens.logs.worlds import Claim, likelier, nwu_from, quaternions_of, world_of


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
        if self.rate_hz is not None and not 1e-3 <= self.rate_hz <= 1e5:
            raise InvalidInputError(f"rate_hz: expected 0.001 to 100000, got {self.rate_hz:g}")
        if self.world is not None:
            nwu_from(self.world)


@dataclass(frozen=True)
class Parts:
    """Samples as they were sent, one row for each message or line.

    Attributes
    ----------
    stamps : Stamps
    vectors : tuple of ndarray, shape (m, 3), or None
        Readings of accelerometer, gyroscope and magnetometer.
    orientations : ndarray, optional
        The sensor's own, in a notation of `quaternions_of`.
    claim : Claim, optional
        Its world; None for one that has nothing to do with north and up.
    increments : tuple of ndarray, shapes (m, 3) and (m, 3) or (m, 4), or None
        Of velocity, and of orientation as rotation vector or quaternion, over each sampling period.
    otherwise : ndarray, optional
        Orientations if the numbers mean something else, as `otherwise_note` says.
    """

    stamps: Stamps
    vectors: tuple[FloatArray | None, ...] = (None, None, None)
    orientations: FloatArray | None = None
    claim: Claim | None = None
    notes: tuple[str, ...] = ()
    increments: tuple[FloatArray | None, FloatArray | None] = (None, None)
    otherwise: FloatArray | None = None
    otherwise_note: str = ""


def assemble_log(parts: Parts, hints: Hints, source: str) -> ImuLog:
    """Build the log of samples, without those that are no measurements.

    Raises
    ------
    InvalidInputError
        If they have neither a clock, nor a rate; if orientation and acceleration contradict each other; or if
        they are of several sensors.
    """
    stamps, notes, rows, vectors = parts.stamps, list(parts.notes), parts.orientations, list(parts.vectors)
    if hints.rate_hz is not None:
        stamps = replace(stamps, period_s=1.0 / hints.rate_hz)
    scaled = []
    for i, part in enumerate(parts.increments):
        if part is not None and vectors[i] is None:
            vectors[i] = _rotation_vectors(part)
            scaled.append(VECTORS[i])
            notes.append(f"{VECTORS[i].split('_')[0]}: increments over the sampling period")
    has_counter = stamps.counter is not None
    if not has_counter and stamps.time_s is None and stamps.period_s > 0.0:
        samples = next(len(v) for v in (stamps.starts, *vectors, rows) if v is not None)
        stamps = replace(stamps, counter=np.arange(samples))
        notes.append("samples have no counter: losses cannot be found")
    rotations, oriented = None, np.zeros(0, dtype=bool)
    if rows is not None:
        wxyz = quaternions_of(rows)
        if parts.otherwise is not None:
            notations = [wxyz, quaternions_of(parts.otherwise)]
            if best := likelier(notations, vectors[0]):
                wxyz = notations[best]
                notes.append(f"orientation: {parts.otherwise_note}, by its own accelerometer")
        oriented = np.asarray(np.isfinite(wxyz).all(axis=1))
        claim = parts.claim if hints.world is None else Claim(hints.world, "as given", final=True)
        world = "NWU" if claim is None else claim.world
        if claim is not None and not hints.as_stated and oriented.any():
            world, world_notes = world_of(claim, wxyz, vectors[0], vectors[2])
            notes += world_notes
        rotations = nwu_from(world) * Rotation.from_quat(
            np.where(oriented[:, None], wxyz, 0.5), scalar_first=True
        )
        if not oriented.all():
            notes.append(f"{int((~oriented).sum())} samples lack the sensor's own orientation")
    stamps, burst_notes = spread(stamps, (*vectors, rows))
    notes += burst_notes
    line = timeline(stamps)
    oriented = oriented[line.rows] if oriented.any() else oriented[:0]
    force, rate, field = (None if readings is None else readings[line.rows] for readings in vectors)
    log = ImuLog(
        line.time_s,
        force,
        rate,
        field,
        rotations[line.rows] if rotations is not None and oriented.size else None,
        line.counter if has_counter else None,
        line.gaps,
        (*notes, *line.notes),
        source,
        oriented,
    )
    log = replace(log, **{name: getattr(log, name) * log.rate_hz for name in scaled})
    return without_faults(log)


def _rotation_vectors(numbers: FloatArray) -> FloatArray:
    """Rotation vectors of quaternions, NaN of those that are damage; vectors as they are."""
    if numbers.shape[1] == 3:
        return numbers
    wxyz = quaternions_of(numbers)
    finite = np.isfinite(wxyz)
    turns = Rotation.from_quat(np.where(finite, wxyz, 1.0), scalar_first=True)
    return np.where(finite[:, :1], turns.as_rotvec(), np.nan)
