"""Commands that make again what a viewer shows."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from speckle3d.app.reconstruction.cuts.shown import Shown
from speckle3d.core.arrays import FloatArray
from speckle3d.study.reslices.places import Place

DIGITS = 4
"""Of points' coordinates in mm: those that are measured are the ones that are written."""


def reslice_command(
    source: Path, out: str, shown: Shown, place: Place | None, sweep_file: Path | None = None
) -> str:
    """`speckle3d reslice` of a place, or of the frames' outlines, at the modes shown.

    Parameters
    ----------
    source : path
        The reconstruction.
    out : str
        Picture to write.
    shown : Shown
    place : Place, optional
        None for the outlines.
    sweep_file : path, optional
        The sweep, if it is not where the reconstruction says.
    """
    words = ["speckle3d", "reslice", str(source), "-o", out]
    for mode in shown.modes:
        words += ["--mode", mode]
    if shown.other:
        words += ["--difference-to", shown.mode]
    words += ["--outlines"] if place is None else _where(place)
    return shlex.join([*words, *(["--sweep", str(sweep_file)] if sweep_file else [])])


def _where(place: Place) -> list[str]:
    usual = Place()
    words = []
    for option in ("lateral_mm", "depth_mm", "frame"):
        if (value := getattr(place, option)) is not None:
            words += [_option(option), repr(value)]
    for option in ("origin_mm", "right", "down"):
        if (vector := getattr(place, option)) is not None:
            words += [_option(option.removesuffix("_mm")), *(repr(float(each)) for each in vector)]
    for option in ("pixel_mm", "reach_mm"):
        if (value := getattr(place, option)) != getattr(usual, option):
            words += [_option(option), repr(value)]
    return words


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def measure_command(source: Path, mode: str, points_mm: Sequence[FloatArray]) -> str:
    """`speckle3d measure` between points of a mode's world."""
    words = ["speckle3d", "measure", str(source), "--mode", mode]
    for point in points_mm:
        words += ["--point", ",".join(repr(float(each)) for each in point)]
    return shlex.join(words)
