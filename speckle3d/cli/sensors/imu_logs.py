"""Logs of the orientation sensor for commands: a file of its own, a sweep, or the sensor inside a probe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from speckle3d.cli.common import note, notes

if TYPE_CHECKING:
    from speckle3d.core.streams import TimedRotations
    from xsens.fusion.orient import Orientation
    from xsens.logs.samples import ImuLog

World = Annotated[Literal["ENU", "NWU", "NED"] | None, typer.Option(case_sensitive=False)]
Method = Literal["smoother", "filter", "vqf", "vqf-online", "sensor"]


def read(path: Path, rate_hz: float | None = None, world: str | None = None) -> ImuLog:
    """Read a log of any kind, or what a sweep holds of its orientation sensor (its world is known)."""
    from speckle3d.sensor_logs import held_log
    from xsens.logs.parts import Hints
    from xsens.logs.read import read_log

    held = held_log(path)
    if held is None:
        return read_log(path, Hints(rate_hz=rate_hz, world=world))
    if world is not None:
        note("--world is not used: it is for logs, and the world of a recording's stream is known")
    return held


def tell(log: ImuLog) -> None:
    """Report on stderr what a log lacks, and what was assumed in its place."""
    notes(log.notes)
    if log.gaps:
        longest = max(gap.duration_s for gap in log.gaps)
        lost = f"{log.lost} samples lost in {len(log.gaps)} gaps" if log.lost else f"{len(log.gaps)} pauses"
        note(f"{lost}, the longest of {longest:.3f} s; nothing filled in")


def orientation_of(
    log: ImuLog, method: Method, magnetometer: bool
) -> tuple[TimedRotations, Orientation | None]:
    """Find the orientation of a log; the second result is None for the sensor's own orientation."""
    readings = log.gyroscope_rad_s is not None or log.accelerometer_m_s2 is not None
    if method != "sensor" and log.oriented.any() and not readings:
        note("no gyroscope and no accelerometer: the orientation is the sensor's own")
        method = "sensor"
    if method == "sensor":
        return log.rotations(), None
    from xsens.fusion.orient import orient
    from xsens.fusion.settings import FusionSettings

    found = orient(log, FusionSettings(use_magnetometer=magnetometer), method)
    notes(found.notes)
    return found.rotations, found
