"""Pictures of reslices: cuts at the poses of several modes under one grey scale, and how long each mode is.

The lengths over the cuts are those of the tables (`speckle3d.scoring.lengths`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d

from speckle3d.core.arrays import Float32Array
from speckle3d.core.images import spread_frames
from speckle3d.study.figures import (
    RANGE_DB,
    UNSEEN,
    colour_of,
    label_of,
    name_figure,
    new_figure,
    save_figure,
)
from speckle3d.study.posed import SweepModes
from speckle3d.study.reslices.cuts import KEYWORD, CutPicture, cut_at_modes, picture_text
from speckle3d.study.reslices.places import along_sweep

_PIXEL_MM = 0.1
"""Of the cut along a sweep that goes with every reconstruction."""

_DEEP_MM, _LONG_MM = 12.0, 16.0
"""Part of a cut that is enlarged: about as deep as a short sweep is long."""

Extent = tuple[float, float, float, float]

_ACROSS_IN, _DOWN_IN = 11.0, 6.0
"""Width and height that the cuts share."""


def draw_along(modes: SweepModes, lengths: Mapping[str, str], paths: tuple[Path, Path]) -> None:
    """Cut a sweep along its middle at the poses of every mode; write the whole cut and a part enlarged.

    As in figures 7 and 8 of Housden et al., BioMedical Engineering OnLine 7:5, 2008.

    Parameters
    ----------
    modes : SweepModes
        Of all frames.
    lengths : mapping of str to str
        Length of each mode, in words.
    paths : tuple of path
        Of the two PNGs.
    """
    source, _ = modes.posed.source(None, RANGE_DB)
    place = along_sweep(modes, source.grid, pixel_mm=_PIXEL_MM)
    picture = replace(cut_at_modes(modes, place, source), lengths=lengths)
    save_reslices(picture, paths[0])
    panel = picture.cuts[modes.reference]
    left, right, bottom, top = panel.cut.extent_mm
    top += _PIXEL_MM * busiest_rows(panel.image, round(_DEEP_MM / _PIXEL_MM))
    part = left, min(right, left + _LONG_MM), min(bottom, top + _DEEP_MM), top
    save_reslices(replace(picture, place="part of the cut along the sweep, enlarged"), paths[1], part)


def save_reslices(picture: CutPicture, path: Path, part_mm: Extent | None = None) -> Path:
    """Draw cuts, as `draw_cuts`, and write them as a PNG that says where they lie.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    text = picture_text({mode: panel.cut for mode, panel in picture.cuts.items()}, picture.marks)
    return save_figure(draw_cuts(picture, part_mm), path, {KEYWORD: text})


def draw_cuts(picture: CutPicture, part_mm: Extent | None = None) -> Figure:
    """Draw cuts of several modes under one grey scale.

    Parameters
    ----------
    part_mm : tuple of float, optional
        Left, right, bottom and top of what is shown, by the cuts' axes; by default all.
    """
    cuts = picture.cuts
    left, right, bottom, top = part_mm or next(iter(cuts.values())).cut.extent_mm
    size = right - left, bottom - top
    # In as many rows as show the cuts largest.
    grids = [(rows, -(-len(cuts) // rows)) for rows in range(1, len(cuts) + 1)]
    scales = [min(_ACROSS_IN / (c * size[0]), _DOWN_IN / (r * size[1])) for r, c in grids]
    scale, (down, across) = max(zip(scales, grids, strict=True), key=lambda pair: pair[0])
    wide = max(across * (scale * size[0] + 0.6) + 1.6, 5.0)
    figure = new_figure(wide, down * (scale * size[1] + 0.7) + 0.7)
    figure.set_layout_engine("compressed")
    places = figure.subplots(down, across, squeeze=False).ravel()
    greys = colormaps["gray"].with_extremes(bad=UNSEEN)
    titles = ["\n".join(filter(None, [label_of(mode), picture.lengths.get(mode, "")])) for mode in cuts]
    longest = max(len(line) for title in titles for line in title.split("\n"))
    # Beside each other where panels are narrow, too: 0.6 of the size a letter, and 0.3 inches between panels.
    title_size = min(8.33, 72.0 * (scale * size[0] + 0.3) / (0.62 * longest))
    for (mode, panel), title, axes in zip(cuts.items(), titles, places, strict=False):
        look = {"cmap": greys, "interpolation": "nearest", "extent": panel.cut.extent_mm}
        low, high = picture.levels
        image = axes.imshow(panel.image, vmin=low, vmax=high, **look)
        axes.set_title(title, fontsize=title_size, color=colour_of(mode), parse_math=False)
        lines = list(panel.frames[spread_frames(len(panel.frames), 8)])
        axes.add_collection(LineCollection(lines, colors="#FFD700", linewidths=0.6, alpha=0.6), autolim=False)
        axes.set(xlim=(left, right), ylim=(bottom, top))
        axes.tick_params(labelsize="small")
    for axes in places[len(cuts) :]:
        axes.remove()
    for axes in places[: len(cuts) : across]:
        axes.set_ylabel(f"{picture.axes[1]} / mm")
    legend = " (yellow: where frames cross the cut)" if any(len(cut.frames) for cut in cuts.values()) else ""
    figure.supxlabel(f"{picture.axes[0]} / mm{legend}", fontsize="medium")
    figure.colorbar(image, ax=list(places[: len(cuts)]), label=picture.unit, shrink=0.8)
    name_figure(figure, ": ".join(filter(None, [picture.name, picture.place])))
    return figure


def busiest_rows(image: Float32Array, count: int) -> int:
    """First of `count` rows in which structures along the sweep stand out most from speckle."""
    if len(image) <= count or not np.isfinite(image).any():
        return 0
    levels = np.nan_to_num(image, nan=float(np.nanmedian(image)))
    sums = np.convolve(uniform_filter1d(levels, 15, axis=1).var(axis=1), np.ones(count), mode="valid")
    # Near the face the probe's own echo would win.
    first = min(count // 3, len(sums) - 1)
    return first + int(np.argmax(sums[first:]))
