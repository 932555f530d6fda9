"""Commands that make again what a viewer shows."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from speckle3d.core.arrays import FloatArray

_CODE = (
    "font-family:ui-monospace,'DejaVu Sans Mono',monospace;font-size:11px;white-space:pre-wrap;"
    "overflow-wrap:anywhere;user-select:all;background:#f3f5f7;padding:6px;border:1px solid #d5dae0"
)


def reslice_command(
    source: Path, out: str, modes: Sequence[str], place: Mapping[str, float], sweep_file: Path | None = None
) -> str:
    """`speckle3d reslice` of a place at one mode, or at two against the first.

    Parameters
    ----------
    source : path
        The reconstruction.
    out : str
        Picture to write.
    modes : sequence of str
    place : mapping of str to float
        Options of the command by name, as ``depth_mm``.
    sweep_file : path, optional
        The sweep, if it is not where the reconstruction says.
    """
    words = [
        "speckle3d",
        "reslice",
        source,
        "-o",
        out,
        *(word for mode in modes for word in ("--mode", mode)),
    ]
    words += ["--difference-to", modes[0]] if len(modes) > 1 else []
    for name, value in place.items():
        words += ["--" + name.replace("_", "-"), f"{value:g}"]
    return shlex.join([*map(str, words), *(["--sweep", str(sweep_file)] if sweep_file else [])])


def measure_command(source: Path, mode: str, points_mm: Sequence[FloatArray]) -> str:
    """`speckle3d measure` between points of a mode's world."""
    words = ["speckle3d", "measure", str(source), "--mode", mode]
    for point in points_mm:
        words += ["--point", ",".join(repr(float(value)) for value in point)]
    return shlex.join(words)


def code(text: str) -> str:
    """HTML of a command that one click selects."""
    return f'<div style="{_CODE}">{escape(text)}</div>'
