"""Samples as sent, from all readers of logs, and their assembly to an `ImuLog`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps, timeline
from xsens.logs.faults import without_faults
from xsens.logs.samples import VECTORS, ImuLog
from xsens.logs.worlds import Claim, nwu_from, to_nwu


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
    notations : mapping of str to ndarray, shape (m, 4)
        The sensor's own orientation, as `to_nwu` has it.
    claim : Claim, optional
        Its world; None for one that has nothing to do with north and up.
    increments : tuple of ndarray, shapes (m, 3) and (m, 3) or (m, 4), or None
        Of velocity, and rotation vectors, over each sampling period.
    """

    stamps: Stamps
    vectors: tuple[FloatArray | None, ...] = (None, None, None)
    notations: Mapping[str, FloatArray] = field(default_factory=dict)
    claim: Claim | None = None
    notes: tuple[str, ...] = ()
    increments: tuple[FloatArray | None, FloatArray | None] = (None, None)


def assemble_log(parts: Parts, hints: Hints, source: str) -> ImuLog:
    """Build the log of samples, without those that are no measurements.

    Raises
    ------
    InvalidInputError
        If they have neither a clock, nor a rate; if orientation and acceleration contradict each other; or if
        they are of several sensors.
    """
    stamps, notes, vectors = parts.stamps, list(parts.notes), list(parts.vectors)
    if hints.rate_hz is not None:
        stamps = replace(stamps, period_s=1.0 / hints.rate_hz)
    scaled = []
    for i, part in enumerate(parts.increments):
        if part is not None and vectors[i] is None:
            vectors[i] = part
            scaled.append(VECTORS[i])
            notes.append(f"{VECTORS[i].split('_')[0]}: increments over the sampling period")
    readings = [part for part in (*vectors, *parts.notations.values()) if part is not None]
    has_counter = stamps.counter is not None
    if not has_counter and stamps.time_s is None and stamps.period_s > 0.0:
        samples = next(len(part) for part in (stamps.starts, *readings) if part is not None)
        stamps = replace(stamps, counter=np.arange(samples))
        notes.append("samples have no counter: losses cannot be found")
    line = timeline(stamps, readings)
    notations = {meaning: wxyz[line.rows] for meaning, wxyz in parts.notations.items()}
    wxyz = next(iter(notations.values()), np.zeros((0, 4)))
    oriented = np.isfinite(wxyz).all(axis=1)
    if missing := int((~oriented).sum()):
        notes.append(f"{missing} samples lack the sensor's own orientation")
    rotations = Rotation.from_quat(np.where(oriented[:, None], wxyz, 0.5), scalar_first=True)
    force, rate, field_au = (None if part is None else part[line.rows] for part in vectors)
    log = ImuLog(
        line.time_s,
        force,
        rate,
        field_au,
        Rotation.from_quat(np.where(oriented[:, None], wxyz, 0.5), scalar_first=True)
        if oriented.any()
        else None,
        line.counter if has_counter else None,
        line.gaps,
        (*notes, *line.notes),
        source,
        oriented,
    )
    log = without_faults(replace(log, **{name: getattr(log, name) * log.rate_hz for name in scaled}))
    if log.world_from_sensor is None:
        return log
    claim = parts.claim if hints.world is None else Claim(hints.world, "as given", final=True)
    return to_nwu(log, notations, claim, hints.as_stated)
