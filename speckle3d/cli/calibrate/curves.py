"""Calibration of decorrelation curves: phantoms in steps, tracked sweeps, data sheets."""

from __future__ import annotations

from typing import Annotated

import speckle3d as s3
from speckle3d.cli.common import (
    MaybePath,
    MaybeText,
    Out,
    Result,
    Sweeps,
    note,
    part_of,
)
from speckle3d.core.errors import naming


def curves(
    out: Annotated[Out, "curves"],
    sweeps: Sweeps = None,
    probe: MaybePath = None,
    like: MaybePath = None,
    start: MaybePath = None,
    region: MaybeText = None,
    frames: MaybeText = None,
    config_file: MaybePath = None,
) -> Result:
    """Measure decorrelation curves on sweeps with known positions, or calculate them from a data sheet.

    One of SWEEPS or --probe. Positions are a sweep's /truth, or else its /tracker.

    Parameters
    ----------
    sweeps
        Phantom sweeps with known positions, or any with a tracker.
    out
        Curves file to write.
    start
        Rough curves to correct by the sweeps' tracker; then they may be over tissue, too. Not with --probe.
    probe
        With --like: TOML with a probe's data sheet: elevation_aperture_mm, elevation_focus_mm, band_mhz.
    like
        With --probe: sweep whose signal, depths and echoes to calculate for.
    region
    frames
        FIRST-LAST: these frames of each sweep only.
    as_json

    Other Parameters
    ----------------
    config_file

    Examples
    --------
    $ speckle3d calibrate curves steps.h5 turning.h5 -o curves.h5
    """
    from speckle3d.io.toml import load_toml
    from speckle3d.sheet_curves import ProbeSheet, data_sheet_curves
    from speckle3d.tracked_curves import jitters, tracked_curves

    settings = s3.load_config(config_file).with_choices(region=region)
    if probe is not None and like is not None:
        with naming(str(probe)):
            sheet = load_toml(ProbeSheet, probe)
            result = data_sheet_curves(sheet, s3.load_sweep(like), settings)
    else:
        rough = s3.load_curves(start) if start else None
        recordings = [part_of(s3.load_sweep(path), frames, "--frames") for path in sweeps or []]
        with s3.progress_bar("correlating frames") as progress:
            if rough is not None or all(jitters(sweep) for sweep in recordings):
                result = tracked_curves(recordings, rough, settings, progress)
            else:
                result = s3.calibrate_curves(recordings, settings, progress)
    s3.write_curves(out, result)
    return _report(result)


def _report(curves: s3.DecorrelationCurves) -> Result:
    import numpy as np

    first = (curves.correlation < 0.5).argmax(axis=1)
    half_mm = np.where(curves.correlation.min(axis=1) < 0.5, curves.distance_mm[first], np.nan)
    by_depth = {"depth_mm": curves.depth_mm, "half_mm": half_mm, "cells": curves.cells}
    tilt = {} if curves.tilt is None else vars(curves.tilt)
    about = {"pairs": curves.pairs_used, "origin": curves.origin, "scale_sigma": curves.scale_sigma}
    pairs = f", {curves.pairs_used} frame pairs" if curves.pairs_used else ""
    source = curves.origin.replace("tracked", "tracked sweep")
    lines = [f"curves by {source}{pairs}; correlation falls to one half at"]
    for depth, distance, cells in zip(curves.depth_mm, half_mm, curves.cells, strict=True):
        width = f"{distance:.2f}" if np.isfinite(distance) else f"more than {curves.distance_mm[-1]:.2f}"
        lines.append(f"  {depth:5.1f} mm depth: {width} mm  ({cells:.0f} independent cells in a patch)")
    error = f"+- {196 * curves.scale_sigma:.1f} % (95 %)"
    lines.append(f"lengths read with them on sweeps of a probe like this: {error}")
    if curves.tilt is None:
        why = "the phantom sweeps hardly turned" if curves.pairs_used else "no phantom was turned"
        note(f"{why}: a deliberate tilt will not be seen; add a sweep that turns to see it")
    return by_depth | tilt | about, "\n".join(lines)
