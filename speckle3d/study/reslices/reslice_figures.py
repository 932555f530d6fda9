"""Pictures of reslices: cuts at the poses of several modes under one grey scale, and how long each mode is.

The lengths over the cuts are those of the tables (`speckle3d.scoring.lengths`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.study.figures import (
    RANGE_DB,
    colour_of,
    label_of,
    name_figure,
    new_figure,
    save_figure,
    show_grey,
    spread_frames,
)
from speckle3d.study.images import GreyImages
from speckle3d.study.posed import OpenedModes
from speckle3d.study.reslices.cut_geometry import KEYWORD, picture_text
from speckle3d.study.reslices.cuts import CutPicture, DrawnCut, cut_posed
from speckle3d.study.reslices.places import along_sweep

_BRIGHTEST_PERCENTILE = 99.9
"""Taken as the maximum: a single specular echo must not darken the tissue."""

_PIXEL_MM = 0.1
"""Of the cut along a sweep that goes with every reconstruction."""

_DEEP_MM, _LONG_MM = 12.0, 16.0
"""Part of a cut that is enlarged: about as deep as a short sweep is long."""

_ACROSS_IN, _DOWN_IN = 11.0, 6.0
"""Width and height that the cuts share."""


def draw_along(
    opened: OpenedModes, images: GreyImages, lengths: Mapping[str, str], paths: tuple[Path, Path]
) -> None:
    """Cut a sweep along its middle at the poses of every mode; write the whole cut and a part enlarged.

    As in figures 7 and 8 of Housden et al., BioMedical Engineering OnLine 7:5, 2008.

    Parameters
    ----------
    opened : OpenedModes
        Of all frames.
    images : GreyImages
        Over `RANGE_DB`.
    lengths : mapping of str to str
        How long each mode is, in words.
    paths : tuple of path
        Of the two PNGs.
    """
    # A reach of two of the longest steps, so that no gaps show between frames.
    steps = [(each[0].inv() * each).translation[:, 2] for each in opened.poses.values()]
    reach_mm = max(0.3, *(2.0 * float(np.percentile(np.abs(np.diff(each)), 99)) for each in steps))
    place = along_sweep(opened, images.grid, pixel_mm=_PIXEL_MM)
    picture = cut_posed(opened, place, RANGE_DB, (images, images.grid), reach_mm=reach_mm)
    picture = replace(picture, lengths=lengths)
    save_reslices(picture, paths[0])
    rows = round(_DEEP_MM / _PIXEL_MM)
    top = busiest_rows(picture.cuts[opened.reference].image, rows)
    parts = {mode: _part(drawn, top, rows) for mode, drawn in picture.cuts.items()}
    enlarged = replace(picture, cuts=parts, place="part of the cut along the sweep, enlarged")
    save_reslices(enlarged, paths[1], 3.0 * len(parts))


def _part(drawn: DrawnCut, top: int, rows: int) -> DrawnCut:
    """Some rows of a cut along the sweep, from its beginning on, and no more columns than `_LONG_MM`."""
    part, plane = drawn.image[top : top + rows, : round(_LONG_MM / _PIXEL_MM)], drawn.cut
    assert isinstance(plane, ReslicePlane)
    height_mm, width_mm = (_PIXEL_MM * max(size - 1, 1) for size in part.shape)
    down = RigidTransform.from_translation([0.0, top * _PIXEL_MM, 0.0])
    first = plane.first_mm[0], plane.first_mm[1] + top * _PIXEL_MM
    return DrawnCut(part, ReslicePlane(plane.world_from_plane * down, width_mm, height_mm, _PIXEL_MM, first))


def save_reslices(picture: CutPicture, path: Path, across_in: float = _ACROSS_IN) -> Path:
    """Draw cuts and write them as a PNG that says where they lie.

    Raises
    ------
    FileError
        If the file cannot be written.
    InvalidInputError
        If no cut shows anything.
    """
    figure, _ = draw_cuts(picture, across_in)
    text = picture_text({mode: each.cut for mode, each in picture.cuts.items()}, picture.marks)
    return save_figure(figure, path, {KEYWORD: text})


def draw_cuts(picture: CutPicture, across_in: float = _ACROSS_IN) -> tuple[Figure, dict[str, Axes]]:
    """Draw cuts of several modes under one grey scale; returns the figure and the panel of each mode.

    Parameters
    ----------
    across_in : float
        Width that the cuts share.

    Raises
    ------
    InvalidInputError
        If no cut shows anything.
    """
    cuts = picture.cuts
    levels = picture.levels or _levels(cuts)
    size = np.max([(drawn.cut.width_mm, drawn.cut.height_mm) for drawn in cuts.values()], axis=0)
    # Cuts in a row or in a column, whichever shows them larger.
    grids = [(1, len(cuts)), (len(cuts), 1)]
    scales = [min(across_in / (c * size[0]), _DOWN_IN / (r * size[1])) for r, c in grids]
    scale, (down, across) = max(zip(scales, grids, strict=True))
    wide = max(across * (scale * size[0] + 0.6) + 1.6, 5.0)
    figure = new_figure(wide, down * (scale * size[1] + 0.7) + 0.7)
    places = figure.subplots(down, across, squeeze=False).ravel()
    panels = dict(zip(cuts, places, strict=True))
    for mode, drawn in cuts.items():
        image = show_grey(panels[mode], drawn.image, drawn.cut.extent_mm, levels)
        title = "\n".join(filter(None, [label_of(mode), picture.lengths.get(mode, "")]))
        panels[mode].set_title(title, fontsize="small", color=colour_of(mode), parse_math=False)
        lines = list(drawn.frames[spread_frames(len(drawn.frames), 8)])
        panels[mode].add_collection(
            LineCollection(lines, colors="#FFD700", linewidths=0.6, alpha=0.6), autolim=False
        )
        panels[mode].tick_params(labelsize="small")
    places[0].set_ylabel(f"{picture.axes[1]} / mm")
    places[-1 if down > 1 else 0].set_xlabel(f"{picture.axes[0]} / mm")
    figure.colorbar(image, ax=list(places), label=picture.unit, shrink=0.8)
    name_figure(figure, ": ".join(filter(None, [picture.name, picture.place])))
    return figure, panels


def busiest_rows(image: Float32Array, count: int) -> int:
    """First of `count` rows in which structures along the sweep stand out most from speckle."""
    if len(image) <= count or not np.isfinite(image).any():
        return 0
    filled = np.nan_to_num(image, nan=float(np.nanmedian(image)))
    sums = np.convolve(uniform_filter1d(filled, 15, axis=1).var(axis=1), np.ones(count), mode="valid")
    # Near the face the probe's own echo would win.
    first = min(count // 3, len(sums) - 1)
    return first + int(np.argmax(sums[first:]))


def _levels(cuts: Mapping[str, DrawnCut]) -> tuple[float, float]:
    """Black and white: of dB below the maximum the usual range, of other levels from their least on."""
    finite: FloatArray = np.concatenate([each.image[np.isfinite(each.image)] for each in cuts.values()])
    if not finite.size:
        raise InvalidInputError(f"reslices of {', '.join(cuts)}: expected a finite value in one, got none")
    if finite.min() < 0:
        return -RANGE_DB, 0.0
    return float(finite.min()), max(float(np.percentile(finite, _BRIGHTEST_PERCENTILE)), 1e-6 + finite.min())
