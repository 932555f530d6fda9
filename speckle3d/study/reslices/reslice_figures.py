"""Pictures of reslices: cuts at the poses of several modes under one grey scale, and how long each mode is.

The lengths over the cuts are those of the tables (`speckle3d.scoring.lengths`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.cuts.outlines import frame_outlines
from speckle3d.imaging.cuts.planes import ReslicePlane, lateral_line, planes_from_first_frame
from speckle3d.imaging.cuts.reslice import reslice_frames
from speckle3d.matching.intensity import IntensityExtractor
from speckle3d.scoring.lengths import ModeError
from speckle3d.scoring.references import Reference
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
from speckle3d.study.images import PIXEL_MM, Strip
from speckle3d.study.reslices.cut_geometry import KEYWORD, PicturedCut, anchors_of
from speckle3d.study.reslices.cuts import CutPicture, DrawnCut, OpenedModes, drawn_cuts, length_words
from speckle3d.study.reslices.places import view_of

_BRIGHTEST_PERCENTILE = 99.9
"""Taken as the maximum: a single specular echo must not darken the tissue."""

_DEEP_MM, _LONG_MM = 12.0, 16.0
"""Part of a cut that is enlarged: about as deep as a short sweep is long."""

_LARGEST_MM = (400.0, 200.0)
"""Of the cut along a sweep that goes with every reconstruction, however far a mode runs away."""

_ACROSS_IN, _DOWN_IN = 11.0, 6.0
"""Width and height that the cuts share."""


def draw_strip(
    strip: Strip,
    poses: Mapping[str, RigidTransform],
    reference: Reference | None,
    name: str,
    rows: Sequence[ModeError],
    paths: tuple[Path, Path],
) -> None:
    """Cut a sweep along its middle at the poses of every mode; write the whole cut and a part enlarged.

    As in figures 7 and 8 of Housden et al., BioMedical Engineering OnLine 7:5, 2008, the tracker alone stands
    beside the modes.

    Parameters
    ----------
    poses : mapping of str to RigidTransform, length n
        By mode, "tracker" among them where the sensor alone is shown.
    reference : Reference, optional
        Shown, too, if it covers every frame.
    rows : sequence of ModeError
        The modes' lengths.
    paths : tuple of path
        Of the two PNGs.
    """
    shown, last = dict(poses), "image"
    if reference is not None and reference.covered.all():
        shown[reference.name], last = reference.world_from_image, reference.name
    grid, lateral_mm = strip.stack.grid, float(strip.stack.grid.centre_mm[0])
    kept = strip.stack.images(len(poses["image"]))
    planes = planes_from_first_frame(shown, lateral_line(grid, lateral_mm), PIXEL_MM, _LARGEST_MM)
    levels = []
    for mode, each in shown.items():
        # A reach of two of the longest steps, so that no gaps show between frames.
        steps = np.diff((each[0].inv() * each).translation[:, 2])
        reach_mm = max(0.3, 2.0 * float(np.percentile(np.abs(steps), 99)))
        levels.append(reslice_frames(kept, grid, each, planes[mode], reach_mm))
    seen = np.concatenate([each[np.isfinite(each)] for each in levels])
    maximum = np.float32(np.percentile(seen, _BRIGHTEST_PERCENTILE)) if seen.size else np.float32(0.0)
    images = {mode: each - maximum for mode, each in zip(shown, levels, strict=True)}
    where = f"at lateral {lateral_mm:.4g} mm", view_of(planes[last], shown[last])
    picture = CutPicture(
        drawn_cuts(images, planes, grid, shown),
        place=", ".join(filter(None, where)),
        levels=(-RANGE_DB, 0.0),
        name=name,
        anchors={mode: anchors_of(each) for mode, each in shown.items()},
        lengths=length_words(rows, last),
    )
    save_reslices(picture, paths[0])
    rows_shown = round(_DEEP_MM / PIXEL_MM)
    top = busiest_rows(images[last], rows_shown)
    parts = {mode: _part(images[mode], planes[mode], top, rows_shown) for mode in images}
    place = "part of the cut along the sweep, enlarged"
    save_reslices(replace(picture, cuts=parts, place=place), paths[1], 3.0 * len(parts))


def _part(image: Float32Array, plane: ReslicePlane, top: int, rows: int) -> DrawnCut:
    """Some rows of a cut along the sweep, from its beginning on, and no more columns than `_LONG_MM`."""
    part = image[top : top + rows, : round(_LONG_MM / PIXEL_MM)]
    height_mm, width_mm = (PIXEL_MM * max(size - 1, 1) for size in part.shape)
    down = RigidTransform.from_translation([0.0, top * PIXEL_MM, 0.0])
    first = plane.first_mm[0], plane.first_mm[1] + top * PIXEL_MM
    return DrawnCut(part, ReslicePlane(plane.world_from_plane * down, width_mm, height_mm, PIXEL_MM, first))


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
    cuts = [PicturedCut(mode, each.cut, picture.anchors.get(mode, {})) for mode, each in picture.cuts.items()]
    words = {"axes": picture.axes, "place": picture.place, "name": picture.name}
    record = {"version": 1, **words, "cuts": [each.record() for each in cuts]}
    return save_figure(figure, path, {KEYWORD: json.dumps(record)})


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
        # A volume has none of the colours of modes.
        colour = "#404040" if mode == "volume" else colour_of(mode, list(cuts))
        image = show_grey(panels[mode], drawn.image, drawn.cut.extent_mm, levels)
        title = "\n".join(filter(None, [label_of(mode), picture.lengths.get(mode, "")]))
        panels[mode].set_title(title, fontsize="small", color=colour, parse_math=False)
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


def save_outlines(opened: OpenedModes, path: Path) -> Path:
    """Draw the outlines of a sweep's frames at several modes, all from the first one's place; write a PNG.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    grid = IntensityExtractor.for_sweep(opened.posed.sweep).grid
    figure = new_figure(7.0, 6.5)
    axes: Any = figure.add_subplot(projection="3d")
    for mode, poses in opened.poses.items():
        outlines = frame_outlines(grid, poses[0].inv() * poses)
        # Along the sweep comes second; a line is broken between frames.
        lines = outlines[spread_frames(len(outlines), 30)][..., [0, 2, 1]]
        broken = np.pad(lines, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 3)
        colour = colour_of(mode, list(opened.poses))
        axes.plot(*broken.T, color=colour, linewidth=0.6, label=label_of(mode))
    axes.set_xlabel("lateral / mm", labelpad=12)
    axes.set_ylabel("along the sweep / mm", labelpad=12)
    axes.set_zlabel("depth / mm", labelpad=8)
    axes.tick_params(labelsize="small")
    axes.invert_zaxis()
    sides = [np.ptp(limits) for limits in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    axes.set_box_aspect(sides, zoom=0.72)
    axes.view_init(elev=22.0, azim=-35.0)
    axes.locator_params(nbins=4)
    axes.legend(frameon=False, fontsize="small")
    name_figure(figure, f"{opened.posed.sweep.name}: frames, all from the first one's place")
    return save_figure(figure, path)


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
