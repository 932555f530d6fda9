"""Calibration of decorrelation curves: phantoms in steps, tracked sweeps, data sheets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.common import ConfigFile, Json, calibrate, emit, emit_json, load_settings, note
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.config import Config
    from speckle3d.core.curves import DecorrelationCurves


@calibrate.command("curves")
def calibrate_curves(
    out: Annotated[Path, typer.Option("-o", "--output", help="Curves file to write.")],
    sweeps: Annotated[
        list[Path] | None, typer.Argument(help="Phantom sweeps with known positions, or any with a tracker.")
    ] = None,
    probe: Annotated[
        Path | None,
        typer.Option(
            help="TOML with a probe's data sheet: elevation_aperture_mm, elevation_focus_mm, band_mhz."
        ),
    ] = None,
    like: Annotated[
        Path | None,
        typer.Option(help="With --probe: sweep whose signal, depths and echoes to calculate for."),
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(
            help="Rough curves to correct by the sweeps' tracker; then they may be over tissue, too."
        ),
    ] = None,
    config_file: ConfigFile = None,
    as_json: Json = False,
) -> None:
    """Measure decorrelation curves on sweeps with known positions, or calculate them from a data sheet.

    Positions are a sweep's /truth, or else its /tracker.
    """
    from speckle3d.io.curves import write_curves

    require_own_place(out, "curves", *(sweeps or []), config_file, probe, like, start)
    settings = load_settings(config_file)
    if (probe is None) == (not sweeps):
        raise InvalidInputError("expected sweeps to measure curves on, or --probe, got both or neither")
    if like is not None and probe is None:
        raise InvalidInputError("--like: expected --probe with it, got none")
    if start is not None and probe is not None:
        raise InvalidInputError("--start: expected sweeps with a tracker beside it, got --probe")
    if probe is not None:
        curves = _of_sheet(probe, like, settings)
    else:
        curves = _measured(sweeps or [], start, settings)
    write_curves(out, curves)
    _show(curves, as_json)


def _of_sheet(probe: Path, like: Path | None, settings: Config) -> DecorrelationCurves:
    from speckle3d.core.errors import naming
    from speckle3d.io.load import load_sweep
    from speckle3d.io.toml import load_toml
    from speckle3d.motion.data_sheet import ProbeSheet
    from speckle3d.sheet_curves import data_sheet_curves

    sheet = load_toml(ProbeSheet, probe)
    with naming(str(probe)):
        return data_sheet_curves(sheet, load_sweep(like) if like else None, settings)


def _measured(paths: list[Path], start: Path | None, settings: Config) -> DecorrelationCurves:
    from speckle3d.io.curves import read_curves
    from speckle3d.io.load import load_sweep
    from speckle3d.phantom_curves import calibrate_curves as measure
    from speckle3d.tracked_curves import jitters, tracked_curves

    sweeps = [load_sweep(path) for path in paths]
    with progress_bar("correlating frames") as progress:
        if start is not None:
            return tracked_curves(sweeps, read_curves(start), settings, progress)
        if all(jitters(sweep) for sweep in sweeps):
            return tracked_curves(sweeps, None, settings, progress)
        return measure(sweeps, settings, progress)


def _show(curves: DecorrelationCurves, as_json: bool) -> None:
    half = [_half_distance(curves.distance_mm, row) for row in curves.correlation]
    if as_json:
        table: dict[str, Any] = {
            "depth_mm": curves.depth_mm.tolist(),
            "half_mm": half,
            "cells": curves.cells.tolist(),
        }
        if curves.tilt is not None:
            table |= {name: values.tolist() for name, values in vars(curves.tilt).items()}
        about = {"pairs": curves.pairs_used, "origin": curves.origin, "scale_sigma": curves.scale_sigma}
        emit_json(table | about)
        return
    seen = f"{curves.pairs_used} frame pairs" if curves.pairs_used else "calculated, not measured"
    emit(f"{seen}; correlation falls to one half at")
    for depth, distance, cells in zip(curves.depth_mm, half, curves.cells, strict=True):
        emit(f"  {depth:5.1f} mm depth: {distance:.2f} mm  ({cells:.0f} independent cells in a patch)")
    emit(f"lengths read with them on sweeps of a probe like this: {100 * curves.scale_sigma:.1f} % (1 sigma)")
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
