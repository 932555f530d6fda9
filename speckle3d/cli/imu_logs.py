"""Logs of the orientation sensor for commands: a file of its own, a sweep, or the sensor inside a probe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.common import note

if TYPE_CHECKING:
    from speckle3d.core.sweep import OrientationSensor
    from xsens.logs.samples import Gap, ImuLog

Log = Annotated[
    Path,
    typer.Argument(
        metavar="LOG",
        help="A log of the sensor, of any kind that is known, or a sweep with one. A plain CSV has the "
        "columns time_s, accelerometer_x_m_s2, gyroscope_x_rad_s, magnetometer_x_au (y and z likewise), "
        "quaternion_w to _z.",
    ),
]
RateHz = Annotated[float | None, typer.Option(help="Samples per second, for logs that do not say.")]


class World(StrEnum):
    """World that the sensor's own orientation is seen from: east, north, up and so on."""

    ENU = "ENU"
    NWU = "NWU"
    NED = "NED"


WorldOption = Annotated[
    World | None,
    typer.Option(
        "--world",
        case_sensitive=False,
        help="World of the sensor's own orientation; by default as its accelerometer and magnetometer show.",
    ),
]


def read(path: Path, rate_hz: float | None = None, world: str | None = None) -> ImuLog:
    """Read a log of any kind, or what a sweep holds of its orientation sensor (its world is known)."""
    from xsens.logs.parts import Hints
    from xsens.logs.read import read_log

    held = None
    inside = _inside_probe(path)
    if inside is None and (held := ridden_along(path)) is not None:
        inside = log_of(held, path.name)
    if inside is not None:
        if world is not None:
            note("--world is not used: it is for logs, and the world of a recording's stream is known")
        return inside
    return read_log(path, Hints(rate_hz=rate_hz, world=world))


def ridden_along(path: Path) -> OrientationSensor | None:
    """The orientation sensor that a sweep was recorded with, as one inside a probe; None of what is a log."""
    from speckle3d.core.errors import InsufficientDataError
    from speckle3d.io.load import load_sweep
    from speckle3d.io.readers import find_reader

    if find_reader(path) is None or _inside_probe(path) is not None:
        return None
    sensor = load_sweep(path).orientation
    if sensor is None:
        raise InsufficientDataError(f"{path}: expected an orientation sensor's stream in the sweep, got none")
    return sensor


def _inside_probe(path: Path) -> ImuLog | None:
    """Log of the sensor inside a handheld scanner, whatever its images are; None of other recordings."""
    from speckle3d.io.clarius import READER
    from speckle3d.io.clarius.imu import sensor_notes
    from speckle3d.io.clarius.reader import sensor_of
    from speckle3d.io.readers import find_reader
    from xsens.logs.clocks import timeline_of_times
    from xsens.logs.samples import ImuLog

    if find_reader(path) is not READER:
        return None
    samples, fit = sensor_of(path)
    clock = timeline_of_times(samples.time_s)
    found = "is not used: it fits none of its other readings" if fit is None else f"is {fit.meaning}"
    return ImuLog(
        clock.time_s,
        samples.accelerometer_m_s2(fit),
        samples.gyroscope_rad_s,
        samples.magnetometer_gauss,
        world_from_sensor=None if fit is None else fit.world_from_sensor,
        gaps=_pauses(clock.gaps),
        notes=(*clock.notes, f"the sensor's quaternion {found}", *sensor_notes(samples)),
        source=path.name,
    )


def log_of(sensor: OrientationSensor, source: str) -> ImuLog:
    """Log of a sweep's orientation sensor, on its own clock."""
    from speckle3d.core.sweep import INERTIAL
    from xsens.logs.clocks import timeline_of_times
    from xsens.logs.samples import ImuLog

    clock = timeline_of_times(sensor.readings.time_s)
    return ImuLog(
        clock.time_s,
        **{name: getattr(sensor, name) for name in INERTIAL},
        world_from_sensor=sensor.readings.world_from_sensor,
        gaps=_pauses(clock.gaps),
        notes=clock.notes,
        source=source,
    )


def _pauses(gaps: Sequence[Gap]) -> tuple[Gap, ...]:
    """Gaps of a sensor without a counter that may send in bursts: how many were lost is not known."""
    return tuple(replace(gap, lost=0) for gap in gaps)


def tell(log: ImuLog) -> None:
    """Report on stderr what a log lacks, and what was assumed in its place."""
    for text in log.notes:
        note(text)
    if log.gaps:
        longest = max(gap.duration_s for gap in log.gaps)
        lost = f"{log.lost} samples lost in {len(log.gaps)} gaps" if log.lost else f"{len(log.gaps)} pauses"
        note(f"{lost}, the longest of {longest:.3f} s; nothing filled in")
