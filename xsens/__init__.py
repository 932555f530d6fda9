"""The orientation sensor: its messages, logs and orientation; usable without speckle3d's upper floors.

The public names below are loaded when first used (PEP 562), so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from speckle3d.core.streams import TimedRotations
    from xsens.accuracy import AccuracyTable, PairErrors, common_readings, mounting_from_motion, pair_errors
    from xsens.accuracy_figures import figure_turns
    from xsens.bytelogs import parse_stream
    from xsens.comparison import compare_orientations
    from xsens.device import DeviceError, DeviceSettings
    from xsens.framing import Framer, Message, decode, encode
    from xsens.fusion import Orientation, orient
    from xsens.fusion_settings import FusionSettings
    from xsens.live import LiveState
    from xsens.logparts import Hints
    from xsens.logs import read_log, write_csv
    from xsens.mechanism import MechanismSettings, read_mechanism_csv, readings_at
    from xsens.online import OnlineFilter, OnlineState
    from xsens.recording import Recorder, record
    from xsens.samples import Gap, ImuLog

_HOME = {
    "AccuracyTable": "accuracy",
    "DeviceError": "device",
    "DeviceSettings": "device",
    "Framer": "framing",
    "FusionSettings": "fusion_settings",
    "Gap": "samples",
    "Hints": "logparts",
    "ImuLog": "samples",
    "LiveState": "live",
    "MechanismSettings": "mechanism",
    "Message": "framing",
    "OnlineFilter": "online",
    "OnlineState": "online",
    "Orientation": "fusion",
    "PairErrors": "accuracy",
    "Recorder": "recording",
    "TimedRotations": "speckle3d.core.streams",
    "common_readings": "accuracy",
    "compare_orientations": "comparison",
    "decode": "framing",
    "encode": "framing",
    "figure_turns": "accuracy_figures",
    "mounting_from_motion": "accuracy",
    "orient": "fusion",
    "pair_errors": "accuracy",
    "parse_stream": "bytelogs",
    "read_log": "logs",
    "read_mechanism_csv": "mechanism",
    "readings_at": "mechanism",
    "record": "recording",
    "write_csv": "logs",
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
        home = _HOME[name]
        value = getattr(import_module(home if "." in home else f"{__name__}.{home}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
