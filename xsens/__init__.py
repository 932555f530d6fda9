"""The orientation sensor: its messages, logs and orientation; usable without speckle3d's upper floors.

The public names below are loaded when first used (PEP 562), so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from speckle3d.core.streams import TimedRotations
    from xsens.accuracy.angles import (
        AccuracyTable,
        PairErrors,
        common_readings,
        mounting_from_motion,
        pair_errors,
    )
    from xsens.accuracy.comparison import compare_orientations
    from xsens.accuracy.figures import figure_turns
    from xsens.accuracy.mechanism import MechanismSettings, read_mechanism_csv, readings_at
    from xsens.fusion.online import OnlineFilter, OnlineState
    from xsens.fusion.orient import Orientation, orient
    from xsens.fusion.settings import FusionSettings
    from xsens.live.device import DeviceError, DeviceSettings
    from xsens.live.monitor import LiveState
    from xsens.live.recording import Recorder, record
    from xsens.logs.bytelogs import parse_stream
    from xsens.logs.logparts import Hints
    from xsens.logs.read import read_log, write_csv
    from xsens.logs.samples import Gap, ImuLog
    from xsens.messages.framing import Framer, Message, decode, encode

_HOME = {
    "AccuracyTable": "xsens.accuracy.angles",
    "DeviceError": "xsens.live.device",
    "DeviceSettings": "xsens.live.device",
    "Framer": "xsens.messages.framing",
    "FusionSettings": "xsens.fusion.settings",
    "Gap": "xsens.logs.samples",
    "Hints": "xsens.logs.logparts",
    "ImuLog": "xsens.logs.samples",
    "LiveState": "xsens.live.monitor",
    "MechanismSettings": "xsens.accuracy.mechanism",
    "Message": "xsens.messages.framing",
    "OnlineFilter": "xsens.fusion.online",
    "OnlineState": "xsens.fusion.online",
    "Orientation": "xsens.fusion.orient",
    "PairErrors": "xsens.accuracy.angles",
    "Recorder": "xsens.live.recording",
    "TimedRotations": "speckle3d.core.streams",
    "common_readings": "xsens.accuracy.angles",
    "compare_orientations": "xsens.accuracy.comparison",
    "decode": "xsens.messages.framing",
    "encode": "xsens.messages.framing",
    "figure_turns": "xsens.accuracy.figures",
    "mounting_from_motion": "xsens.accuracy.angles",
    "orient": "xsens.fusion.orient",
    "pair_errors": "xsens.accuracy.angles",
    "parse_stream": "xsens.logs.bytelogs",
    "read_log": "xsens.logs.read",
    "read_mechanism_csv": "xsens.accuracy.mechanism",
    "readings_at": "xsens.accuracy.mechanism",
    "record": "xsens.live.recording",
    "write_csv": "xsens.logs.read",
}
"""Where each public name lives."""

__all__ = [
    "AccuracyTable",
    "DeviceError",
    "DeviceSettings",
    "Framer",
    "FusionSettings",
    "Gap",
    "Hints",
    "ImuLog",
    "LiveState",
    "MechanismSettings",
    "Message",
    "OnlineFilter",
    "OnlineState",
    "Orientation",
    "PairErrors",
    "Recorder",
    "TimedRotations",
    "common_readings",
    "compare_orientations",
    "decode",
    "encode",
    "figure_turns",
    "mounting_from_motion",
    "orient",
    "pair_errors",
    "parse_stream",
    "read_log",
    "read_mechanism_csv",
    "readings_at",
    "record",
    "write_csv",
]


if not TYPE_CHECKING:  # or every misspelt name would pass as an object

    def __getattr__(name: str) -> object:
        """Load a public name on first use."""
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(_HOME[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
