"""Calibration of decorrelation curves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from speckle3d.cli.common import (
    ConfigFile,
    Json,
    calibrate,
    emit,
    emit_json,
    load_settings,
    note,
    progress_bar,
)
from speckle3d.cli.outputs import require_own_place


@calibrate.command("curves")
def calibrate_curves(
    phantoms: Annotated[list[Path], typer.Argument(help="Phantom sweeps whose positions are known.")],
    out: Annotated[Path, typer.Option("-o", "--output", help="Curves file to write.")],
    config_file: ConfigFile = None,
    as_json: Json = False,
) -> None:
    """Measure decorrelation curves on phantom sweeps with known positions (/truth, or else /tracker)."""
    from speckle3d.io.curves import write_curves
    from speckle3d.io.load import load_sweep
    from speckle3d.phantom_curves import calibrate_curves as measure

    require_own_place(out, "curves", *phantoms, config_file)
    with progress_bar("correlating phantom frames") as progress:
        curves = measure([load_sweep(path) for path in phantoms], load_settings(config_file), progress)
    write_curves(out, curves)
    half = [_half_distance(curves.distance_mm, row) for row in curves.correlation]
    if as_json:
        table = {"depth_mm": curves.depth_mm.tolist(), "half_mm": half, "cells": curves.cells.tolist()}
        if curves.tilt is not None:
            table |= {name: values.tolist() for name, values in vars(curves.tilt).items()}
        emit_json(table | {"pairs": curves.pairs_used})
        return
    emit(f"{curves.pairs_used} frame pairs; correlation falls to one half at")
    for depth, distance, cells in zip(curves.depth_mm, half, curves.cells, strict=True):
        emit(f"  {depth:5.1f} mm depth: {distance:.2f} mm  ({cells:.0f} independent cells in a patch)")
    if curves.tilt is None:
        note("the phantom sweeps hardly turned: tilt will be taken to be about the image's centre")
    else:
        pivots = [
            f"{depth - pivot:.0f}" for depth, pivot in zip(curves.depth_mm, curves.tilt.pivot_mm, strict=True)
        ]
        note(f"tilted frames decorrelate as if they turned about a point {pivots[0]} to {pivots[-1]} mm deep")


def _half_distance(distance_mm: Any, correlation: Any) -> float:
    first = int((correlation < 0.5).argmax())
    return float(distance_mm[first]) if first else float("nan")
