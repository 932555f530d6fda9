"""Pictures of reslices: cuts of several modes under one grey scale, and what sets them apart.

Each cut is also laid over the reference's, the first frames on each other: what both show at one place is
grey, what only this mode shows is magenta, what only the reference shows is green. Below, on a scale of its
own, stands where every mode has the frames along the sweep: a mode that is too long has a longer row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.imaging.cuts.outlines import frame_outlines
from speckle3d.matching.intensity import IntensityExtractor
from speckle3d.study.figures import (
    UNSEEN,
    colour_of,
    label_of,
    name_figure,
    new_figure,
    save_figure,
    show_grey,
    wrapped,
)
from speckle3d.study.reslices.cut_geometry import save_cuts
from speckle3d.study.reslices.cut_panels import add_axes_in, laid_out, name_axes
from speckle3d.study.reslices.cuts import CutPicture, DrawnCut, OpenedModes

_BRIGHTEST_PERCENTILE = 99.9
"""A single specular echo must not darken the tissue."""

_OVERLAY_PERCENTILES = (5.0, 99.5)
"""Levels of the reference that are dark and bright in an overlay, so that its colours are strong."""

_MAGENTA, _GREEN = "#FF30FF", "#20FF20"

_ROW_IN = 0.24
_FRAME_IN = 0.3
"""Width of the number of a frame."""

_STEPS = np.outer(10 ** np.arange(6), [1, 2, 5]).ravel()
"""Round numbers of frames from one line to the next."""


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


def draw_cuts(picture: CutPicture) -> tuple[Figure, dict[str, list[Axes]]]:
    """Draw cuts of several modes under one grey scale, and each laid over the reference's.

    Returns
    -------
    (Figure, dict of str to list of Axes)
        The panels of each mode: its cut, and its overlay if it has one.

    Raises
    ------
    InvalidInputError
        If no cut shows anything.
    """
    picture = _reference_last(picture)
    cuts, reference = picture.cuts, picture.reference
    levels = picture.levels or _levels(cuts, picture.unit)
    width, height = np.max([(drawn.cut.width_mm, drawn.cut.height_mm) for drawn in cuts.values()], axis=0)
    layout = laid_out(len(cuts), (float(width), float(height)), reference is not None)
    rows = _sweep_rows(picture)
    figure = layout.figure(0.8 + _ROW_IN * len(rows) if rows else 0.0)
    panels = {mode: [layout.add_panel(figure, i, False)] for i, mode in enumerate(cuts)}
    for mode, drawn in cuts.items():
        # A volume has no mode, and none of the colours of modes.
        colour = colour_of(mode, list(cuts)) if len(drawn.frames) else "#404040"
        _draw_cut(panels[mode][0], drawn, (label_of(mode), colour), levels, layout.panel_in[0])
        _number_frames(panels[mode][0], drawn, picture.numbers, layout.panel_in[0])
    if reference is not None:
        contrast = contrast_of(cuts[reference].image, levels)
        for i, mode in enumerate(cuts):
            panel = layout.add_panel(figure, i, True)
            if mode == reference:
                _explain_overlays(panel, label_of(reference), layout.panel_in[0])
            else:
                panels[mode].append(panel)
                _draw_overlay(panel, cuts[mode], cuts[reference], label_of(reference), contrast)
    name_axes([each for row in panels.values() for each in row], picture.axes)
    _draw_colours(figure, panels[next(iter(cuts))][0], picture.unit)
    if rows:
        _draw_rows(figure, rows, reference, picture.numbers)
    # The suptitle's letters are a fifth larger than those that `wrapped` counts on.
    title = printable(": ".join(filter(None, [picture.name, picture.place])))
    name_figure(figure, wrapped(title, figure.get_figwidth() / 1.2))
    return figure, panels


def figure_outlines(outlines_mm: Mapping[str, FloatArray], title: str = "") -> Figure:
    """Draw outlines of frames in space, at the poses of every mode.

    Parameters
    ----------
    outlines_mm : mapping of str to ndarray, shape (n, 5, 3)
        By mode, in one world, that of the first frame: from `frame_outlines`.
    """
    figure = new_figure(7.0, 6.5, None)
    axes: Any = figure.add_axes((0.08, 0.1, 0.8, 0.8), projection="3d")
    for mode, outlines in outlines_mm.items():
        # Depth down: the image's y is the picture's -z.
        lines = [each[:, [0, 2, 1]] for each in outlines[_shown_frames(len(outlines), 30)]]
        colour = colour_of(mode, list(outlines_mm))
        axes.add_collection3d(Line3DCollection(lines, colors=colour, linewidths=0.6, label=label_of(mode)))
    points = np.concatenate([each.reshape(-1, 3) for each in outlines_mm.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), zlim=(high[1], low[1]))
    axes.set_box_aspect(np.maximum(high - low, 1e-3)[[0, 2, 1]], zoom=0.9)
    axes.view_init(elev=22.0, azim=-35.0)
    axes.set(xlabel="lateral / mm", ylabel="along the sweep / mm", zlabel="depth / mm")
    axes.locator_params(nbins=5)
    figure.legend(frameon=False, fontsize="small", loc="lower right")
    name_figure(figure, f"{title}: frames, all from the first one's place")
    return figure


def save_outlines(opened: OpenedModes, path: Path) -> Path:
    """Draw the outlines of a sweep's frames at several modes, all from the first one's place; write a PNG.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    grid = IntensityExtractor.for_sweep(opened.posed.sweep).grid
    outlines = {mode: frame_outlines(grid, poses[0].inv() * poses) for mode, poses in opened.poses.items()}
    return save_figure(figure_outlines(outlines, opened.posed.sweep.name), path)


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


def _reference_last(picture: CutPicture) -> CutPicture:
    order = sorted(picture.cuts, key=lambda mode: mode == picture.reference)
    return replace(picture, cuts={mode: picture.cuts[mode] for mode in order})


def _draw_cut(
    axes: Axes, drawn: DrawnCut, name: tuple[str, str], levels: tuple[float, float], width_in: float
) -> None:
    """Draw a cut under its name and colour, with lines of some frames."""
    label, colour = name
    show_grey(axes, drawn.image, drawn.cut.extent_mm, levels)
    title = wrapped(label, width_in)
    axes.set_title(title, fontsize="medium", color=colour, y=1.0, pad=12, parse_math=False)
    shown = _shown_frames(len(drawn.frames), _frames_in(width_in))
    # A black line in a grey picture would be taken for tissue.
    _draw_frames(axes, drawn.frames[shown], "#FFD700" if colour == "#000000" else colour)
    _draw_scale(axes, drawn.cut.extent_mm, width_in)


def _number_frames(axes: Axes, drawn: DrawnCut, numbers: IntArray | None, width_in: float) -> None:
    """Write the numbers of the frames that are drawn above their lines."""
    left, right, _, top = drawn.cut.extent_mm
    for index in _shown_frames(len(drawn.frames), _frames_in(width_in)):
        line = drawn.frames[index]
        if np.isfinite(line).any():
            x = line[np.nanargmin(line[:, 1]), 0]
            if abs(2 * x - left - right) <= 1.04 * (right - left):
                _write(axes, str(index if numbers is None else numbers[index]), (x, top), 1, "0.4")


def _frames_in(width_in: float) -> int:
    return max(2, int(width_in / _FRAME_IN))


def _draw_overlay(
    axes: Axes, drawn: DrawnCut, reference: DrawnCut, name: str, contrast: tuple[float, float]
) -> None:
    """Lay a mode's cut (magenta) over the reference's (green)."""
    colours = overlay(drawn.image, reference.image, contrast)
    axes.imshow(colours, aspect="equal", extent=drawn.cut.extent_mm, interpolation="nearest")
    shown = _shown_frames(len(drawn.frames), 8)
    _draw_frames(axes, reference.frames[shown], _GREEN)
    _draw_frames(axes, drawn.frames[shown], _MAGENTA)
    axes.set_title(f"over {name}", fontsize="small", color="0.3", y=1.0, pad=3, parse_math=False)


def _explain_overlays(axes: Axes, reference: str, width_in: float) -> None:
    """Say in the reference's own panel, which would show nothing, what colours mean."""
    axes.set_axis_off()
    words = (
        ("grey: both", "0.5"),
        ("blue-grey: no frame", UNSEEN),
        ("magenta: the mode alone", "#C000C0"),
        (f"green: {reference} alone", "#008000"),
    )
    for i, (text, colour) in enumerate(words):
        axes.annotate(
            wrapped(text, width_in + 0.7),
            (0, 1),
            (0, -2 - 26 * i),
            xycoords="axes fraction",
            textcoords="offset points",
            fontsize="x-small",
            va="top",
            color=colour,
            parse_math=False,
        )


def _write(
    axes: Axes, text: str, place: tuple[float, float], up_points: float, colour: str, **look: Any
) -> None:
    """Write small above a place of the axes, on them or not."""
    axes.annotate(
        text,
        place,
        (0, up_points),
        textcoords="offset points",
        ha="center",
        color=colour,
        annotation_clip=False,
        **{"fontsize": "xx-small", **look},
    )


def _draw_frames(axes: Axes, lines: FloatArray, colour: str) -> None:
    axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=0.7, alpha=0.7), autolim=False)


def _draw_scale(axes: Axes, extent_mm: tuple[float, float, float, float], width_in: float) -> None:
    left, right, bottom, top = extent_mm
    span = right - left
    # Room for the words below it.
    wanted = span * min(0.5, max(0.15, 0.35 / width_in))
    tenths = [0.1 * step for step in _STEPS]
    length = min((each for each in tenths if each >= wanted), default=wanted)
    length = length if length < 0.9 * span else wanted
    x, y = left + 0.05 * span, bottom - 0.04 * (bottom - top)
    look: dict[str, Any] = {"color": "white", "linewidth": 2.5, "solid_capstyle": "butt"}
    axes.plot([x, x + length], [y, y], path_effects=[withStroke(linewidth=4.5, foreground="black")], **look)
    edge = [withStroke(linewidth=2.0, foreground="black")]
    _write(axes, f"{length:g} mm", (x + length / 2, y), 4, "white", fontsize="x-small", path_effects=edge)


def _draw_colours(figure: Figure, axes: Axes, unit: str) -> None:
    place, width = axes.get_position(), figure.get_figwidth()
    right = max(each.get_position().x1 for each in figure.axes)
    tall = min(place.height, 3.0 / figure.get_figheight())
    bar = figure.add_axes((right + 0.15 / width, place.y0, 0.14 / width, tall))
    figure.colorbar(axes.images[0], cax=bar, label=unit)
    bar.tick_params(labelsize="small")


def _sweep_rows(picture: CutPicture) -> dict[str, FloatArray]:
    """Where every mode has the frames along the sweep, by the picture's x; nothing for other cuts."""
    if picture.axes[0] != "along the sweep" or not all(len(drawn.centres) for drawn in picture.cuts.values()):
        return {}
    return {mode: drawn.centres for mode, drawn in picture.cuts.items()}


def _draw_rows(
    figure: Figure, rows: Mapping[str, FloatArray], reference: str | None, numbers: IntArray | None
) -> None:
    """Draw every mode's frames on a line of its own; dotted is where the reference has them."""
    axes = add_axes_in(figure, 1.7, 0.5, figure.get_figwidth() - 3.4, _ROW_IN * len(rows))
    there = rows[reference or next(iter(rows))]
    shown = _shown_frames(len(there), 14)
    axes.vlines(there[shown], -0.5, len(rows) - 0.5, colors="0.7", linestyles=":", linewidths=0.8)
    length = float(np.ptp(there))
    look: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "fontsize": "small", "va": "center"}
    for y, (mode, x) in enumerate(rows.items()):
        colour = colour_of(mode, list(rows))
        low, high = float(x.min()), float(x.max())
        axes.plot([low, high], [y, y], color=colour, linewidth=1.5)
        axes.vlines(x[shown], y - 0.28, y + 0.28, colors=colour, linewidths=1.5)
        percent = (
            f"  {100 * ((high - low) / length - 1):+.1f} %"
            if mode != reference and reference and length
            else ""
        )
        axes.annotate(f"{high - low:.2f} mm{percent}", (1.01, y), color=colour, **look)
        axes.annotate(label_of(mode), (-0.01, y), color=colour, ha="right", parse_math=False, **look)
    for index in shown:
        _write(axes, str(index if numbers is None else numbers[index]), (there[index], -0.55), 1, "0.4")
    axes.set(ylim=(len(rows) - 0.5, -0.5), yticks=[])
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.tick_params(labelsize="small")
    axes.set_xlabel("frames' centres along the sweep, mm from the first", fontsize="small")


def _levels(cuts: Mapping[str, DrawnCut], unit: str) -> tuple[float, float]:
    finite: FloatArray = np.concatenate([each.image[np.isfinite(each.image)] for each in cuts.values()])
    if not finite.size:
        raise InvalidInputError(f"reslices of {', '.join(cuts)}: expected a finite value in one, got none")
    brightest = float(np.percentile(finite, _BRIGHTEST_PERCENTILE))
    black = brightest - 50.0 if unit == "dB" else float(finite.min())
    return min(black, brightest - 1e-6), brightest


def contrast_of(image: Float32Array, levels: tuple[float, float]) -> tuple[float, float]:
    """Levels that are dark and bright in an overlay on this image; `levels` if it shows nothing."""
    finite = image[np.isfinite(image)]
    if not finite.size:
        return levels
    low, high = (float(each) for each in np.percentile(finite, _OVERLAY_PERCENTILES))
    return (low, high) if high > low else levels


def _shown_frames(count: int, most: int) -> IntArray:
    """Numbers of the frames that are drawn: the first, the last, and a round number apart between."""
    if count == 0:
        return np.empty(0, dtype=np.int64)
    every = next((int(step) for step in _STEPS if count / step <= most), count)
    picked = np.unique([0, *range(0, count, every), count - 1])
    if len(picked) > 2 and picked[-1] - picked[-2] < 0.7 * every:
        picked = np.delete(picked, -2)
    return picked
