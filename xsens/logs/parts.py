"""Samples as sent, from all readers of logs, and their assembly to an `ImuLog`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps, timeline
from xsens.logs.faults import without_faults
from xsens.logs.samples import ImuLog
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
    vectors : mapping of str to ndarray, shape (m, 3)
        Readings by the names in `VECTORS`.
    notations : mapping of str to ndarray, shape (m, 4)
        The sensor's own orientation, as `to_nwu` has it.
    claim : Claim, optional
        Its world; None for one that has nothing to do with north and up.
    increments : mapping of str to ndarray, shape (m, 3)
        Of velocity, and rotation vectors, over each sampling period, by the names of their rates.
    """

    stamps: Stamps
    vectors: Mapping[str, FloatArray]
    notations: Mapping[str, FloatArray]
    claim: Claim | None
    notes: tuple[str, ...]
    increments: Mapping[str, FloatArray]


def assemble_log(parts: Parts, hints: Hints, source: str) -> ImuLog:
    """Build the log of samples, without those that are no measurements.

    Raises
    ------
    InvalidInputError
        If they have neither a clock, nor a rate; if orientation and acceleration contradict each other; or if
        they are of several sensors.
    """
    stamps, vectors = parts.stamps, {**parts.increments, **parts.vectors}
    if hints.rate_hz is not None:
        stamps = replace(stamps, period_s=1.0 / hints.rate_hz)
    scaled = [name for name in parts.increments if name not in parts.vectors]
    notes = [*parts.notes, *(f"{name.split('_')[0]}: increments over the sampling period" for name in scaled)]
    line = timeline(stamps, [*vectors.values(), *parts.notations.values()])
    notations = {meaning: wxyz[line.rows] for meaning, wxyz in parts.notations.items()}
    wxyz = next(iter(notations.values()), np.zeros((0, 4)))
    oriented = np.isfinite(wxyz[:, 0])
    if missing := int((~oriented).sum()):
        notes.append(f"{missing} samples lack the sensor's own orientation")
    rotations = Rotation.from_quat(np.where(oriented[:, None], wxyz, 0.5), scalar_first=True)
    columns: dict[str, Any] = {name: part[line.rows] for name, part in vectors.items()}
    log = ImuLog(
        line.time_s,
        **columns,
        world_from_sensor=rotations if oriented.any() else None,
        counter=line.counter,
        gaps=line.gaps,
        notes=(*notes, *line.notes),
        source=source,
        oriented=oriented,
    )
    log = without_faults(replace(log, **{name: columns[name] * log.rate_hz for name in scaled}))
    if log.world_from_sensor is None:
        return log
    claim = parts.claim if hints.world is None else Claim(hints.world, "as given", final=True)
    return to_nwu(log, notations, claim, hints.as_stated)
