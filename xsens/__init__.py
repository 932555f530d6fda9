"""The orientation sensor: its messages, logs and orientation; usable without speckle3d's upper floors.

The public names below are loaded when first used (PEP 562), so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from xsens.bytelogs import parse_stream
    from xsens.framing import Framer, Message, decode, encode
    from xsens.logparts import Hints
    from xsens.logs import read_log, write_csv
    from xsens.samples import Gap, ImuLog

_HOME = {
    "Framer": "framing",
    "Gap": "samples",
    "Hints": "logparts",
    "ImuLog": "samples",
    "Message": "framing",
    "decode": "framing",
    "encode": "framing",
    "parse_stream": "bytelogs",
    "read_log": "logs",
    "write_csv": "logs",
}
"""Where each public name lives."""

__all__ = [
    "Framer",
    "Gap",
    "Hints",
    "ImuLog",
    "Message",
    "decode",
    "encode",
    "parse_stream",
    "read_log",
    "write_csv",
]


if not TYPE_CHECKING:  # or every misspelt name would pass as an object

    def __getattr__(name: str) -> object:
        """Load a public name on first use."""
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
