"""Pictures of reslices: cuts of several modes under one grey scale, and what sets each apart from a reference.

Beside each cut it is laid over the reference's, the first frames on each other: what both show at one place is
grey, what only this mode shows is magenta, what only the reference shows is green. Below, on a scale of its
own, stands where every mode has the frames along the sweep: a mode that is too long has a longer row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.study.cut_geometry import save_cuts
from speckle3d.study.cuts import CutPicture, DrawnCut
from speckle3d.study.figures import UNSEEN, colour_of, label_of, name_figure, new_figure, show_grey, wrapped

_BRIGHTEST_PERCENTILE = 99.9
"""A single specular echo must not darken the tissue."""

_OVERLAY_PERCENTILES = (5.0, 99.5)
"""Levels of the reference that are dark and bright in an overlay, so that its colours are strong."""

_MAGENTA, _GREEN = "#FF30FF", "#20FF20"

_ROOM_IN = (9.0, 7.5)
"""Width and height that the panels share."""

_LEFT_IN, _RIGHT_IN, _TOP_IN, _BOTTOM_IN = 0.75, 0.95, 0.45, 0.5
_GAP_IN = (0.2, 0.62)
"""Between panels side by side, and one above the other: for the lower one's name."""

_NAME_IN, _ROW_IN, _LARGEST_PANEL_IN = 0.45, 0.24, 7.0
_FRAME_IN = 0.3
"""Width of the number of a frame."""

_STEPS = np.outer(10 ** np.arange(6), [1, 2, 5]).ravel()
"""Round numbers of frames from one line to the next."""


@dataclass(frozen=True)
class _Layout:
    """Where panels stand: a grid of equal ones, in inches from the top left of the figure.

    Attributes
    ----------
    rows, columns : int
    panel : tuple of float
        Width and height of each.
    overlay : tuple of int
        Rows and columns from a mode's cut to its overlay.
    step : tuple of int
        Rows and columns from one mode to the next.
    """

    rows: int
    columns: int
    panel: tuple[float, float]
    overlay: tuple[int, int]
    step: tuple[int, int]

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of all panels."""
        width, height = self.panel
        across, down = _GAP_IN
        return (
            self.columns * (width + across) - across,
            self.rows * (height + down) - down,
        )

    def corner(self, number: int, overlay: bool) -> tuple[float, float]:
        """Left and top of a mode's panel."""
        row, column = (number * step + overlay * more for step, more in zip(self.step, self.overlay, strict=True))
        return (
            column * (self.panel[0] + _GAP_IN[0]),
            row * (self.panel[1] + _GAP_IN[1]),
        )


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
    return save_cuts(figure, path, cuts, panels, words)


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
    layout = _laid_out(cuts, reference is not None)
    rows = _sweep_rows(picture)
    below = _NAME_IN + _ROW_IN * len(rows) + 0.35 if rows else 0.0
    width = max(_LEFT_IN + layout.size[0] + _RIGHT_IN, 4.5)
    height = _TOP_IN + _NAME_IN + layout.size[1] + _BOTTOM_IN + below
    figure = new_figure(width, height, None)
    panels = {mode: [_panel(figure, layout, i, False)] for i, mode in enumerate(cuts)}
    for mode, drawn in cuts.items():
        _draw_cut(panels[mode][0], picture, mode, drawn, levels, layout.panel[0])
    if reference is not None:
        contrast = _contrast(cuts[reference], levels)
        for i, mode in enumerate(cuts):
            panel = _panel(figure, layout, i, True)
            if mode == reference:
                _explain_overlays(panel, label_of(reference))
            else:
                panels[mode].append(panel)
                _draw_overlay(panel, picture, mode, contrast)
    _name_axes(panels, picture.axes)
    _draw_colours(figure, panels[next(iter(cuts))][0], picture.unit)
    if rows:
        _draw_rows(figure, picture, rows)
    name_figure(figure, " ".join(filter(None, [picture.name, picture.place])))
    return figure, panels


def figure_outlines(outlines_mm: Mapping[str, FloatArray], title: str = "") -> Figure:
    """Draw outlines of frames in space, at the poses of every mode.

    Parameters
    ----------
    outlines_mm : mapping of str to ndarray, shape (n, 5, 3)
        By mode, in one world, that of the first frame: from `frame_outlines`.
    """
    figure = new_figure(7.0, 6.5, None)
    axes = figure.add_axes((0.02, 0.05, 0.86, 0.85), projection="3d")
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


def _reference_last(picture: CutPicture) -> CutPicture:
    order = sorted(picture.cuts, key=lambda mode: mode == picture.reference)
    return replace(picture, cuts={mode: picture.cuts[mode] for mode in order})


def _laid_out(cuts: Mapping[str, DrawnCut], compared: bool) -> _Layout:
    """The arrangement of panels in which they are largest."""
    n = len(cuts)
    width = max(drawn.cut.width_mm for drawn in cuts.values())
    height = max(drawn.cut.height_mm for drawn in cuts.values())
    # Cuts in a row or a column; overlays below them, or each beside its own.
    ways = [(1, n, (0, 0), (0, 1)), (n, 1, (0, 0), (1, 0))]
    if compared:
        ways = [(2, n, (1, 0), (0, 1)), (1, 2 * n, (0, 1), (0, 2)), (n, 2, (0, 1), (1, 0))]

    def inches_per_mm(way: tuple[int, int, tuple[int, int], tuple[int, int]]) -> float:
        rows, columns = way[:2]
        across = (_ROOM_IN[0] - (columns - 1) * _GAP_IN[0]) / columns
        down = (_ROOM_IN[1] - (rows - 1) * _GAP_IN[1]) / rows
        return min(max(across, 0.4) / width, max(down, 0.4) / height, _LARGEST_PANEL_IN / max(width, height))

    best = max(ways, key=inches_per_mm)
    scale = inches_per_mm(best)
    return _Layout(best[0], best[1], (max(scale * width, 0.4), max(scale * height, 0.4)), best[2], best[3])


def _panel(figure: Figure, layout: _Layout, number: int, overlay: bool) -> Axes:
    width, height = figure.get_size_inches()
    left, top = layout.corner(number, overlay)
    low = height - _TOP_IN - _NAME_IN - top - layout.panel[1]
    place = ((_LEFT_IN + left) / width, low / height, layout.panel[0] / width, layout.panel[1] / height)
    axes = figure.add_axes(place)
    # An overlay has no numbers of its own beside its cut, nor has a cut beside another.
    axes.tick_params(labelleft=left == 0, labelsize="small")
    for axis, inches in zip(("x", "y"), layout.panel, strict=True):
        axes.locator_params(axis=axis, nbins=int(np.clip(2.0 * inches, 2, 8)))
    return axes


def _draw_cut(
    axes: Axes, picture: CutPicture, mode: str, drawn: DrawnCut, levels: tuple[float, float], width_in: float
) -> None:
    modes = list(picture.cuts)
    colour = colour_of(mode, modes)
    show_grey(axes, drawn.image, drawn.cut.extent_mm, levels)
    axes.set_title(wrapped(label_of(mode), width_in), fontsize="medium", color=colour, y=1.0, pad=12,
                   parse_math=False)  # fmt: skip
    shown = _shown_frames(len(drawn.frames), max(2, int(width_in / _FRAME_IN)))
    # A black line in a grey picture would be taken for tissue.
    _draw_frames(axes, drawn.frames[shown], "#FFD700" if colour == "#000000" else colour)
    for number, line in zip(shown, drawn.frames[shown], strict=True):
        if np.isfinite(line).all():
            x = line[np.argmin(line[:, 1]), 0]
            axes.annotate(str(number), (x, axes.get_ylim()[1]), (0, 1), textcoords="offset points",
                          fontsize="xx-small", ha="center", color="0.4", annotation_clip=False)  # fmt: skip
    _draw_scale(axes, drawn.cut.extent_mm, width_in)


def _draw_overlay(axes: Axes, picture: CutPicture, mode: str, contrast: tuple[float, float]) -> None:
    """Lay a mode's cut (magenta) over the reference's (green)."""
    drawn, reference = picture.cuts[mode], picture.cuts[str(picture.reference)]
    low, high = contrast
    one, other = (np.clip((each.image - low) / (high - low), 0.0, 1.0) for each in (drawn, reference))
    colours = np.stack([one, other, one], axis=-1)
    neither = np.isnan(one) & np.isnan(other)
    colours = np.nan_to_num(colours)
    colours[neither] = [int(UNSEEN[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    axes.imshow(colours, aspect="equal", extent=drawn.cut.extent_mm, interpolation="nearest")
    shown = _shown_frames(len(drawn.frames), 8)
    _draw_frames(axes, reference.frames[shown], _GREEN)
    _draw_frames(axes, drawn.frames[shown], _MAGENTA)
    axes.set_title(f"over {label_of(str(picture.reference))}", fontsize="small", color="0.3", y=1.0, pad=3,
                   parse_math=False)  # fmt: skip


def _explain_overlays(axes: Axes, reference: str) -> None:
    """Say in the reference's own panel, which would show nothing, what colours mean."""
    axes.set_axis_off()
    words = (("grey", "both", "0.5"), ("magenta", "the mode alone", "#C000C0"), ("green", f"{reference} alone", "#008000"))
    for i, (name, meaning, colour) in enumerate(words):
        text = wrapped(f"{name}: {meaning}", axes.get_position().width * axes.get_figure().get_figwidth() + 0.7)
        axes.annotate(text, (0, 1), (0, -2 - 26 * i), xycoords="axes fraction", textcoords="offset points",
                      fontsize="x-small", va="top", color=colour, parse_math=False)  # fmt: skip


def _draw_frames(axes: Axes, lines: FloatArray, colour: str) -> None:
    axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=0.8, alpha=0.85), autolim=False)


def _draw_scale(axes: Axes, extent_mm: tuple[float, float, float, float], width_in: float) -> None:
    left, right, bottom, top = extent_mm
    span = right - left
    # Room for the words below it.
    wanted = span * min(0.5, max(0.15, 0.35 / width_in))
    tenths = [0.1 * step for step in _STEPS]
    length = min((each for each in tenths if each >= wanted), default=wanted)
    length = length if length < 0.9 * span else wanted
    x, y = left + 0.05 * span, bottom - 0.04 * (bottom - top)
    stroke = [withStroke(linewidth=4.5, foreground="black")]
    axes.plot([x, x + length], [y, y], color="white", linewidth=2.5, path_effects=stroke, solid_capstyle="butt")
    axes.annotate(f"{length:g} mm", (x + length / 2, y), (0, 4), textcoords="offset points", ha="center",
                  fontsize="x-small", color="white",
                  path_effects=[withStroke(linewidth=2.0, foreground="black")])  # fmt: skip


def _name_axes(panels: Mapping[str, Sequence[Axes]], names: tuple[str, str]) -> None:
    shown = [each for row in panels.values() for each in row]
    places = [each.get_position() for each in shown]
    left, low = min(place.x0 for place in places), min(place.y0 for place in places)
    for axes, place in zip(shown, places, strict=True):
        if place.x0 <= left + 1e-6:
            axes.set_ylabel(f"{names[1]} / mm")
            if place.y0 <= low + 1e-6:
                axes.set_xlabel(f"{names[0]} / mm", loc="left")


def _draw_colours(figure: Figure, axes: Axes, unit: str) -> None:
    place, width = axes.get_position(), figure.get_figwidth()
    right = max(each.get_position().x1 for each in figure.axes)
    bar = figure.add_axes((right + 0.15 / width, place.y0, 0.14 / width, min(place.height, 3.0 / figure.get_figheight())))
    figure.colorbar(axes.images[0], cax=bar, label=unit)
    bar.tick_params(labelsize="small")


def _sweep_rows(picture: CutPicture) -> dict[str, FloatArray]:
    """Where every mode has the frames along the sweep, by the picture's x; only of several modes."""
    if picture.axes[0] != "along the sweep" or picture.reference is None:
        return {}
    rows = {mode: drawn.frames.mean(axis=1)[:, 0] for mode, drawn in picture.cuts.items()}
    return rows if all(np.isfinite(each).any() for each in rows.values()) else {}


def _draw_rows(figure: Figure, picture: CutPicture, rows: Mapping[str, FloatArray]) -> None:
    """Draw every mode's frames on a line of its own; dotted is where the reference has them."""
    width, height = figure.get_size_inches()
    bottom, tall = 0.5, _ROW_IN * len(rows)
    words_in = 1.5
    axes = figure.add_axes(((0.2 + words_in) / width, bottom / height, (width - 2 * words_in - 0.4) / width, tall / height))
    there = rows[str(picture.reference)]
    shown = _shown_frames(len(there), 14)
    axes.vlines(there[shown], -0.5, len(rows) - 0.5, colors="0.7", linestyles=":", linewidths=0.8)
    length = float(np.nanmax(there) - np.nanmin(there))
    for y, (mode, x) in enumerate(rows.items()):
        colour = colour_of(mode, list(rows))
        own = float(np.nanmax(x) - np.nanmin(x))
        axes.plot([np.nanmin(x), np.nanmax(x)], [y, y], color=colour, linewidth=1.5)
        axes.vlines(x[shown], y - 0.28, y + 0.28, colors=colour, linewidths=1.5)
        text = f"{own:.2f} mm"
        if mode != picture.reference and length > 0:
            text += f"  {100 * (own / length - 1):+.1f} %"
        axes.annotate(text, (1.01, y), xycoords=("axes fraction", "data"), fontsize="small", va="center", color=colour)
        axes.annotate(wrapped(label_of(mode), 9.0), (-0.01, y), xycoords=("axes fraction", "data"), fontsize="small",
                      va="center", ha="right", color=colour, parse_math=False)  # fmt: skip
    for number in shown:
        axes.annotate(str(number), (there[number], -0.55), (0, 1), textcoords="offset points", ha="center",
                      fontsize="xx-small", color="0.4")  # fmt: skip
    axes.set(ylim=(len(rows) - 0.5, -0.5), yticks=[])
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.tick_params(labelsize="small")
    axes.set_xlabel("frames along the sweep, mm from the first one", fontsize="small")


def _levels(cuts: Mapping[str, DrawnCut], unit: str) -> tuple[float, float]:
    finite: FloatArray = np.concatenate([each.image[np.isfinite(each.image)] for each in cuts.values()])
    if not finite.size:
        raise InvalidInputError(f"reslices of {', '.join(cuts)}: expected a finite value in one, got none")
    brightest = float(np.percentile(finite, _BRIGHTEST_PERCENTILE))
    black = brightest - 50.0 if unit == "dB" else float(finite.min())
    return min(black, brightest - 1e-6), brightest


def _contrast(drawn: DrawnCut, levels: tuple[float, float]) -> tuple[float, float]:
    finite = drawn.image[np.isfinite(drawn.image)]
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
