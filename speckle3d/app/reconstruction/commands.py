"""Commands that make again what a viewer shows."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from html import escape
from pathlib import Path

_CODE = (
    "font-family:ui-monospace,'DejaVu Sans Mono',monospace;font-size:11px;white-space:pre-wrap;"
    "overflow-wrap:anywhere;user-select:all;background:#f3f5f7;padding:6px;border:1px solid #d5dae0"
)


def command(name: str, source: Path, options: Iterable[tuple[str, object]]) -> str:
    """HTML of a command line about a reconstruction, which one click selects.

    Parameters
    ----------
    name : str
        Of the command.
    source : path
        The reconstruction.
    options : iterable of (str, object)
        Names of options, as ``depth_mm``, and their values.
    """
    words = ["speckle3d", name, str(source)]
    for option, value in options:
        words += [f"--{option.replace('_', '-')}", f"{value:g}" if isinstance(value, float) else str(value)]
    return f'<div style="{_CODE}">{escape(shlex.join(words))}</div>'
