"""Pictures of reslices: cuts at the poses of several modes under one grey scale, and how long each mode is.

Below cuts along the sweep stands where every mode has the frames: a mode that is too long has a longer row.
The lengths beside the rows are those of the tables (`speckle3d.scoring.lengths`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure, FigureBase
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.cuts.outlines import frame_outlines
from speckle3d.matching.intensity import IntensityExtractor
from speckle3d.scoring.lengths import ModeError
from speckle3d.scoring.references import Reference
from speckle3d.study.figures import (
    RANGE_DB,
    UNSEEN,
    colour_of,
    label_of,
    name_figure,
    new_figure,
    save_figure,
    show_grey,
)
from speckle3d.study.images import PIXEL_MM, Strip, cut_frames, middle_planes
from speckle3d.study.reslices.cut_geometry import anchors_of, save_cuts
from speckle3d.study.reslices.cuts import CutPicture, DrawnCut, OpenedModes, length_words
from speckle3d.study.reslices.places import view_of

_BRIGHTEST_PERCENTILE = 99.9
"""Taken as the maximum: a single specular echo must not darken the tissue."""

_OVERLAY_PERCENTILES = (5.0, 99.5)
"""Levels of the reference that are dark and bright in an overlay, so that its colours are strong."""

_DEEP_MM, _LONG_MM = 12.0, 16.0
"""Part of a cut that is enlarged: about as deep as a short sweep is long."""

_ACROSS_IN, _DOWN_IN, _ROW_IN = 11.0, 6.0, 0.28
"""Width and height that the cuts share, and height of a mode's row."""

_STEPS = np.outer(10 ** np.arange(6), [1, 2, 5]).ravel()
"""Round numbers of frames from one line to the next."""


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
    shown = dict(poses)
    if reference is not None and reference.covered.all():
        shown[reference.name] = reference.world_from_image
    left = RigidTransform.from_translation([strip.left_mm, 0.0, 0.0])
    placed = {mode: each * left for mode, each in shown.items()}
    planes = middle_planes(placed, strip.grid)
    images = {mode: cut_frames(strip, strip.grid, each, planes[mode]) for mode, each in placed.items()}
    seen = np.concatenate([each[np.isfinite(each)] for each in images.values()])
    maximum = np.float32(np.percentile(seen, _BRIGHTEST_PERCENTILE)) if seen.size else np.float32(0.0)
    cuts = {
        mode: DrawnCut.of_sweep(image - maximum, planes[mode], strip.grid, placed[mode])
        for mode, image in images.items()
    }
    last = reference.name if reference is not None and reference.name in shown else "image"
    where = (
        f"at lateral {strip.left_mm + strip.grid.width_mm / 2:.4g} mm",
        view_of(planes[last], placed[last]),
    )
    picture = CutPicture(
        cuts,
        place=", ".join(filter(None, where)),
        name=name,
        anchors={mode: anchors_of(each) for mode, each in shown.items()},
        lengths=length_words(rows, last),
    )
    save_reslices(picture, paths[0])
    save_figure(_figure_enlarged({mode: each.image for mode, each in cuts.items()}, last, name), paths[1])


def save_reslices(picture: CutPicture, path: Path) -> Path:
    """Draw cuts and write them as a PNG that says where they lie.

    Raises
    ------
    FileError
        If the file cannot be written.
    InvalidInputError
        If no cut shows anything.
    """
    figure, panels = draw_cuts(picture)
    cuts = {mode: drawn.cut for mode, drawn in picture.cuts.items()}
    words = {"axes": picture.axes, "place": picture.place, "name": picture.name}
    return save_cuts(figure, path, cuts, panels, words, picture.anchors)


def draw_cuts(picture: CutPicture) -> tuple[Figure, dict[str, Axes]]:
    """Draw cuts of several modes under one grey scale; returns the figure and the panel of each mode.

    Raises
    ------
    InvalidInputError
        If no cut shows anything.
    """
    cuts = picture.cuts
    levels = picture.levels or _levels(cuts)
    size = np.max([(drawn.cut.width_mm, drawn.cut.height_mm) for drawn in cuts.values()], axis=0)
    rows = _sweep_rows(picture)
    # Cuts in a row or in a column, whichever shows them larger.
    grids = [(1, len(cuts)), (len(cuts), 1)]
    scales = [min(_ACROSS_IN / (c * size[0]), _DOWN_IN / (r * size[1])) for r, c in grids]
    (down, across), scale = grids[int(np.argmax(scales))], max(scales)
    wide = max(across * (scale * size[0] + 0.6) + 1.6, 5.0)
    tall, below = down * (scale * size[1] + 0.7) + 0.7, (0.9 + _ROW_IN * len(rows)) if rows else 0.0
    figure = new_figure(wide, tall + below)
    above: FigureBase = figure
    if rows:
        above, under = figure.subfigures(2, 1, height_ratios=(tall, below), squeeze=False).ravel()
        _draw_rows(under.subplots(), rows, picture.lengths, picture.numbers)
    places = above.subplots(down, across, squeeze=False).ravel()
    panels = dict(zip(cuts, places, strict=True))
    for mode, drawn in cuts.items():
        # A volume has no mode, and none of the colours of modes.
        colour = colour_of(mode, list(cuts)) if len(drawn.frames) else "#404040"
        image = show_grey(panels[mode], drawn.image, drawn.cut.extent_mm, levels)
        panels[mode].set_title(label_of(mode), fontsize="medium", color=colour, parse_math=False)
        lines = drawn.frames[_shown_frames(len(drawn.frames), 8)]
        collection = LineCollection(list(lines), colors="#FFD700", linewidths=0.6, alpha=0.6)
        panels[mode].add_collection(collection, autolim=False)
        panels[mode].tick_params(labelsize="small")
    places[0].set_ylabel(f"{picture.axes[1]} / mm")
    places[-1 if down > 1 else 0].set_xlabel(f"{picture.axes[0]} / mm")
    above.colorbar(image, ax=list(places), label=picture.unit, shrink=0.8)
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
    points = []
    for mode, poses in opened.poses.items():
        outlines = frame_outlines(grid, poses[0].inv() * poses)
        # Depth down: the image's y is the picture's -z.
        lines = outlines[_shown_frames(len(outlines), 30)][..., [0, 2, 1]]
        colour = colour_of(mode, list(opened.poses))
        axes.add_collection3d(
            Line3DCollection(list(lines), colors=colour, linewidths=0.6, label=label_of(mode))
        )
        points.append(lines.reshape(-1, 3))
    low, high = np.min(np.vstack(points), axis=0), np.max(np.vstack(points), axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(high[2], low[2]))
    axes.set_xlabel("lateral / mm", labelpad=12)
    axes.set_ylabel("along the sweep / mm", labelpad=12)
    axes.set_zlabel("depth / mm", labelpad=8)
    axes.tick_params(labelsize="small")
    axes.set_box_aspect(np.maximum(high - low, 1e-3), zoom=0.72)
    axes.view_init(elev=22.0, azim=-35.0)
    axes.locator_params(nbins=4)
    axes.legend(frameon=False, fontsize="small")
    name_figure(figure, f"{opened.posed.sweep.name}: frames, all from the first one's place")
    return save_figure(figure, path)


def overlay(image: Float32Array, reference: Float32Array, contrast: tuple[float, float]) -> FloatArray:
    """Colours of an image laid over another, shape (rows, columns, 3), 0 to 1: magenta over green.

    Parameters
    ----------
    image, reference : ndarray of float32, shape (rows, columns)
        NaN where nothing was seen.
    contrast : tuple of float
        Levels that are dark and bright; see `contrast_of`.
    """
    low, high = contrast
    one, other = (np.clip((each - low) / (high - low), 0.0, 1.0) for each in (image, reference))
    colours = np.nan_to_num(np.stack([one, other, one], axis=-1))
    colours[np.isnan(one) & np.isnan(other)] = to_rgb(UNSEEN)
    return np.asarray(colours)


def contrast_of(image: Float32Array, levels: tuple[float, float]) -> tuple[float, float]:
    """Levels that are dark and bright in an overlay on this image; `levels` if it shows nothing."""
    finite = image[np.isfinite(image)]
    if not finite.size:
        return levels
    low, high = (float(each) for each in np.percentile(finite, _OVERLAY_PERCENTILES))
    return (low, high) if high > low else levels


def busiest_rows(image: Float32Array, count: int) -> int:
    """First of `count` rows in which structures along the sweep stand out most from speckle."""
    seen = image[np.isfinite(image)]
    if not seen.size:
        return 0
    spread = uniform_filter1d(np.nan_to_num(image, nan=float(np.median(seen))), 15, axis=1).var(axis=1)
    # Near the face the probe's own echo would win.
    first = min(count // 3, max(len(spread) - count, 0))
    sums = np.convolve(spread, np.ones(min(count, len(spread))), mode="valid")
    return first + int(np.argmax(sums[first:])) if len(sums) > first else 0


def _figure_enlarged(images: Mapping[str, Float32Array], reference: str, name: str) -> Figure:
    """The same part of the cut along a sweep at every mode's poses, enlarged."""
    rows, longest = round(_DEEP_MM / PIXEL_MM), round(_LONG_MM / PIXEL_MM)
    top = busiest_rows(images[reference], rows)
    columns = min(longest, *(each.shape[1] for each in images.values()))
    parts = {mode: image[top : top + rows, :columns] for mode, image in images.items()}
    high, wide = next(iter(parts.values())).shape
    extent = (0.0, wide * PIXEL_MM, (top + high) * PIXEL_MM, top * PIXEL_MM)
    figure = new_figure(1.6 + len(parts) * max(3.0 * wide / high, 1.2), 4.2)
    axes = figure.subplots(1, len(parts), sharey=True, squeeze=False)[0]
    for panel, (mode, image) in zip(axes, parts.items(), strict=True):
        drawn = show_grey(panel, image, extent, (-RANGE_DB, 0.0))
        panel.set_title(
            label_of(mode), color=colour_of(mode, list(parts)), fontsize="medium", parse_math=False
        )
    axes[0].set(ylabel="depth / mm", xlabel="along the sweep / mm")
    figure.colorbar(drawn, ax=list(axes), label="dB, 0: maximum")
    name_figure(figure, f"{name}: part of the cut along the sweep, enlarged")
    return figure


def _sweep_rows(picture: CutPicture) -> dict[str, FloatArray]:
    """Where every mode has the frames along the sweep, by the picture's x; nothing for other cuts."""
    if picture.axes[0] != "along the sweep" or not all(len(drawn.centres) for drawn in picture.cuts.values()):
        return {}
    return {mode: drawn.centres for mode, drawn in picture.cuts.items()}


def _draw_rows(
    axes: Axes, rows: Mapping[str, FloatArray], lengths: Mapping[str, str], numbers: IntArray | None
) -> None:
    """Draw some of every mode's frames on a line of its own, with the mode's length beside it."""
    first = next(iter(rows.values()))
    shown = _shown_frames(len(first), 12)
    colours = [colour_of(mode, list(rows)) for mode in rows]
    levels = list(range(len(rows)))
    axes.eventplot([x[shown] for x in rows.values()], colors=colours, lineoffsets=levels, linelengths=0.6)
    axes.hlines(levels, [x.min() for x in rows.values()], [x.max() for x in rows.values()], colors=colours)
    for y, (mode, colour) in enumerate(zip(rows, colours, strict=True)):
        axes.text(1.01, y, lengths.get(mode, ""), transform=axes.get_yaxis_transform(), color=colour,
                  fontsize="small", va="center")  # fmt: skip
    for index in shown:
        text = str(index if numbers is None else numbers[index])
        axes.annotate(text, (first[index], -0.4), ha="center", fontsize="xx-small", color="0.4")
    axes.set_yticks(levels, [label_of(mode) for mode in rows])
    axes.set_ylim(len(rows) - 0.5, -0.8)
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.tick_params(labelsize="small", left=False)
    axes.set_xlabel(
        "frames' centres along the sweep, mm from the first; above: their numbers", fontsize="small"
    )


def _levels(cuts: Mapping[str, DrawnCut]) -> tuple[float, float]:
    """Black and white: of dB below the maximum the usual range, of other levels from their least on."""
    finite: FloatArray = np.concatenate([each.image[np.isfinite(each.image)] for each in cuts.values()])
    if not finite.size:
        raise InvalidInputError(f"reslices of {', '.join(cuts)}: expected a finite value in one, got none")
    if finite.min() < 0:
        return -RANGE_DB, 0.0
    return float(finite.min()), max(float(np.percentile(finite, _BRIGHTEST_PERCENTILE)), 1e-6 + finite.min())


def _shown_frames(count: int, most: int) -> IntArray:
    """Numbers of the frames that are drawn: the first, the last, and a round number apart between."""
    if count == 0:
        return np.empty(0, dtype=np.int64)
    every = next((int(step) for step in _STEPS if count / step <= most), count)
    picked = np.unique([0, *range(0, count, every), count - 1])
    if len(picked) > 2 and picked[-1] - picked[-2] < 0.7 * every:
        picked = np.delete(picked, -2)
    return picked
