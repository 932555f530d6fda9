"""Decorrelation curves from a probe's data sheet, made for a sweep or for settings of their own."""

from __future__ import annotations

import numpy as np

from speckle3d.config import Config
from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import CurveKey, DecorrelationCurves
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import Sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.texture import measured_texture
from speckle3d.motion.data_sheet import ProbeSheet, sheet_curves


def data_sheet_curves(
    sheet: ProbeSheet, like: Sweep | None = None, config: Config | None = None
) -> DecorrelationCurves:
    """Decorrelation curves of a probe that were not measured but calculated, by diffraction.

    Parameters
    ----------
    sheet : ProbeSheet
        What the data sheet says.
    like : Sweep, optional
        A sweep of the probe, whose signal, depths and patches the curves are made for. Of RF its spectrum by
        depth takes the place of the sheet's frequencies and attenuation, and its speckle tells the patches'
        cells. Without a sweep, the sheet must give the sampling rate and the vectors' pitch.
    config : Config, optional

    Raises
    ------
    InvalidInputError
        If the sheet lacks what no sweep tells.
    """
    settings = config or Config()
    if like is None:
        key = _key(sheet, settings)
        first = settings.patches.top_mm + settings.patches.height_mm / 2.0
        rows = np.arange(first, sheet.depth_mm - settings.patches.height_mm / 2.0 + 1e-9, 1.5)
        if rows.size < 2:
            raise InvalidInputError(f"depth_mm: expected room for two patches, got {sheet.depth_mm:g} mm")
        return sheet_curves(sheet, key, rows, largest_mm=settings.curves.largest_mm)
    matcher = FrameMatcher(like, settings.intensity, settings.patches, settings.inplane, settings.matching)
    rows, texture = matcher.patches.row_depth_mm, measured_texture(like, matcher)
    size, seen = texture.speckle_size(), texture.spectra()
    area = 2.0 * np.pi * _filled(rows, size.lateral_mm) * _filled(rows, size.axial_mm)
    known = bool(np.isfinite(area).all())
    return sheet_curves(sheet, matcher.key, rows, seen, area if known else None, settings.curves.largest_mm)


def _filled(depth_mm: FloatArray, values: FloatArray) -> FloatArray:
    """Values by depth, those not known from their neighbours; all NaN if none is known."""
    known = np.isfinite(values)
    return np.interp(depth_mm, depth_mm[known], values[known]) if known.any() else values


def _key(sheet: ProbeSheet, settings: Config) -> CurveKey:
    if sheet.vector_pitch_mm is None:
        raise InvalidInputError("vector_pitch_mm: expected in the probe's settings, or a sweep, got none")
    return CurveKey(
        sheet.signal,
        sheet.vector_pitch_mm,
        settings.patches.width_mm,
        settings.patches.height_mm,
        settings.intensity.equalise_mm,
        settings.matching.correlate,
        settings.intensity.edge_fraction,
        sheet.probe,
    )
