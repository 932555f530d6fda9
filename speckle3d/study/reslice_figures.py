"""Pictures of reslices: cuts side by side under one grey scale, and what sets each apart from a reference.

Below each cut it is laid over the reference's, the first frames on each other: what both show at one place is
grey, what only one shows is green or magenta. Lines are where some of the frames cross the cut; arrows lead
from where the reference has a frame to where the mode has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.study.cut_geometry import save_cuts
from speckle3d.study.cuts import CutPicture, DrawnCut
from speckle3d.study.figures import colour_of, label_of, name_figure, new_figure, show_grey, wrapped

LINES = 8
"""Frames, about, whose lines are drawn."""

_BRIGHTEST_PERCENTILE = 99.9
"""A single specular echo must not darken the tissue."""

_LARGEST_IN = (10.0, 9.0)
_OUTLINED = [withStroke(linewidth=2.0, foreground="black")]


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


def figure_outlines(outlines_mm: Mapping[str, FloatArray], title: str = "") -> Figure:
    """Draw outlines of frames in space, at the poses of every mode.

    Parameters
    ----------
    outlines_mm : mapping of str to ndarray, shape (n, 5, 3)
        By mode, in one world: from `frame_outlines`.
    """
    figure = new_figure(7.0, 6.0)
    axes = figure.add_subplot(projection="3d")
    points = np.concatenate([each.reshape(-1, 3) for each in outlines_mm.values()])
    for mode, outlines in outlines_mm.items():
        some = outlines[_shown_frames(outlines, 4 * LINES)]
        # Depth down: the image's y is the picture's -z.
        lines = [each[:, [0, 2, 1]] for each in some]
        colour = colour_of(mode, list(outlines_mm))
        axes.add_collection3d(Line3DCollection(lines, colors=colour, linewidths=0.7, label=label_of(mode)))
    low, high = points.min(axis=0), points.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), zlim=(high[1], low[1]))
    axes.set_box_aspect(np.maximum(high - low, 1e-3)[[0, 2, 1]])
    axes.set(xlabel="lateral / mm", ylabel="along the sweep / mm", zlabel="depth / mm")
    axes.legend(frameon=False, fontsize="small")
    name_figure(figure, f"{title}: frames, from the first one's place")
    return figure


def draw_cuts(picture: CutPicture) -> tuple[Figure, dict[str, list[Axes]]]:
    """Draw cuts of several modes under one grey scale, and each laid over the reference's.

    Raises
    ------
    InvalidInputError
        If no cut shows anything.
    """
    cuts, reference = picture.cuts, picture.reference
    levels = picture.levels or _levels(cuts, picture.unit)
    wide = _is_wide(cuts)
    figure, rows = _panels(cuts, reference is not None, wide)
    panels: dict[str, list[Axes]] = {}
    for i, (mode, drawn) in enumerate(cuts.items()):
        axes = rows[0][i]
        panels[mode] = [axes]
        show_grey(axes, drawn.image, drawn.cut.extent_mm, levels)
        colour = colour_of(mode, list(cuts))
        name = wrapped(label_of(mode), figure.get_figwidth() / (len(rows) if wide else len(cuts)))
        axes.set_title(name, fontsize="medium", color=colour, parse_math=False)
        _draw_frames(axes, drawn.frames, colour)
        _draw_length(axes, drawn.frames)
        _draw_scale(axes, drawn.cut.extent_mm)
        if reference is not None:
            panels[mode].append(rows[1][i])
            _draw_difference(rows[1][i], mode, drawn, reference, cuts[reference], levels)
    shown = [each for row in rows for each in row]
    for each in shown:
        each.label_outer()
    for each in shown:
        each.set_xlabel(f"{picture.axes[0]} / mm")
        each.set_ylabel(f"{picture.axes[1]} / mm")
    figure.colorbar(rows[0][0].images[0], ax=shown, label=picture.unit, shrink=0.6, pad=0.02)
    name_figure(figure, f"{picture.name}: {picture.place}")
    return figure, panels


def _is_wide(cuts: Mapping[str, DrawnCut]) -> bool:
    return all(drawn.cut.width_mm > drawn.cut.height_mm for drawn in cuts.values())


def _panels(cuts: Mapping[str, DrawnCut], compared: bool, wide: bool) -> tuple[Figure, list[list[Axes]]]:
    n, rows = len(cuts), 1 + compared
    width = max(d.cut.width_mm for d in cuts.values())
    height = max(d.cut.height_mm for d in cuts.values())
    across, down = (rows, n) if wide else (n, rows)
    scale = min(_LARGEST_IN[0] / (across * width), _LARGEST_IN[1] / (down * height), 4.0 / min(width, height))
    figure = new_figure(max(scale * across * width + 1.8, 5.0), scale * down * height + 1.3 + 0.4 * down)
    places = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
    grid = places.T if wide else places
    return figure, [list(row) for row in grid]


def _levels(cuts: Mapping[str, DrawnCut], unit: str) -> tuple[float, float]:
    finite: FloatArray = np.concatenate([d.image[np.isfinite(d.image)] for d in cuts.values()])
    if not finite.size:
        raise InvalidInputError(f"reslices of {', '.join(cuts)}: expected a finite value in one, got none")
    brightest = float(np.percentile(finite, _BRIGHTEST_PERCENTILE))
    return (brightest - 50.0 if unit == "dB" else float(finite.min())), brightest


def _shown_frames(frames: FloatArray, most: int = LINES) -> IntArray:
    """Numbers of the frames whose lines are drawn: the first, the last, and a round number apart between."""
    n = len(frames)
    every = next(
        (step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000) if n / step <= most + 1), n
    )
    picked = np.unique([0, *range(0, n, every), n - 1])
    if len(picked) > 2 and picked[-1] - picked[-2] < every / 2:
        picked = np.delete(picked, -2)
    return picked


def _draw_frames(axes: Axes, frames: FloatArray, colour: str, **look: Any) -> None:
    if not len(frames):
        return
    for number in _shown_frames(frames):
        line = frames[number]
        if np.isfinite(line).any():
            axes.plot(*line.T, color=colour, **{"linewidth": 0.8, "alpha": 0.8, **look})
            axes.annotate(
                str(number),
                line[0],
                (0, 2),
                textcoords="offset points",
                fontsize="xx-small",
                ha="center",
                color="0.3",
                annotation_clip=False,
            )


def _draw_length(axes: Axes, frames: FloatArray) -> None:
    if len(frames) < 2 or not np.isfinite(frames[[0, -1]]).all():
        return
    a, b = frames[0][-1], frames[-1][-1]
    y = max(a[1], b[1])
    axes.annotate(
        "",
        (b[0], y),
        (a[0], y),
        arrowprops={"arrowstyle": "<|-|>", "color": "white", "shrinkA": 0, "shrinkB": 0},
    )
    middle = (frames[0].mean(axis=0), frames[-1].mean(axis=0))
    text = f"{np.linalg.norm(middle[1] - middle[0]):.2f} mm"
    axes.annotate(
        text,
        ((a[0] + b[0]) / 2, y),
        (0, 3),
        textcoords="offset points",
        ha="center",
        fontsize="small",
        color="white",
        path_effects=_OUTLINED,
    )


def _draw_scale(axes: Axes, extent: tuple[float, float, float, float]) -> None:
    left, right, bottom, top = extent
    span = right - left
    length = max(s for s in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if s <= max(span / 3, 0.1))
    x, y = left + 0.04 * span, top + 0.06 * (bottom - top)
    axes.plot(
        [x, x + length],
        [y, y],
        color="white",
        linewidth=3,
        path_effects=[withStroke(linewidth=5, foreground="black")],
    )
    axes.annotate(
        f"{length:g} mm",
        (x + length / 2, y),
        (0, -4),
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize="x-small",
        color="white",
        path_effects=_OUTLINED,
    )


def _draw_difference(
    axes: Axes, mode: str, drawn: DrawnCut, reference: str, there: DrawnCut, levels: tuple[float, float]
) -> None:
    low, high = levels
    one, other = (np.clip((d.image - low) / (high - low), 0, 1) for d in (drawn, there))
    rgb = np.stack([one, other, one], axis=-1)
    unseen = np.isnan(one) & np.isnan(other)
    rgb = np.nan_to_num(rgb)
    rgb[unseen] = (0.2, 0.25, 0.36)
    axes.imshow(rgb, extent=drawn.cut.extent_mm, interpolation="nearest")
    _draw_frames(axes, there.frames, "#7CFC00")
    if mode != reference:
        _draw_frames(axes, drawn.frames, "#FF00FF")
        for number in _shown_frames(drawn.frames):
            a, b = there.frames[number].mean(axis=0), drawn.frames[number].mean(axis=0)
            axes.annotate(
                "",
                b,
                a,
                arrowprops={
                    "arrowstyle": "-|>",
                    "color": "white",
                    "shrinkA": 0,
                    "shrinkB": 0,
                    "linewidth": 1.2,
                },
            )
