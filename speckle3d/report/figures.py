"""The report's figures: what is drawn, and how matplotlib draws it into PNG, SVG and JPEG files."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import ImageGrid
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.report.data import Record, RejectedPatches
from speckle3d.report.reslices import Cut, Cuts
from speckle3d.scoring.references import REFERENCES
from speckle3d.study.figures import (
    DOTS_PER_INCH,
    Panel,
    Series,
    Style,
    colour_of,
    draw_panel,
    figure_panels,
    label_axes,
    label_of,
    new_figure,
    show_grey,
    wrapped,
)
from speckle3d.study.overall import mean_over_sweeps

MOST_POINTS = 240
"""Points of a curve: more than print or screen resolve, and each costs bytes."""

OUTLINES = 20
"""Frames whose outlines are drawn."""

_DETAIL_COLOUR = "#ffd000"


def decimated(frames: int) -> npt.NDArray[np.int64]:
    """Frames to draw: every one of a short sweep, evenly spread ones of a long one, both ends included."""
    return np.unique(np.linspace(0, frames - 1, min(frames, MOST_POINTS)).round().astype(np.int64))


def overview_panels(rows: Sequence[Record], modes: Sequence[str]) -> list[Panel]:
    """Errors of length and tilt: a point for every part of every sweep, a bar at the mean magnitude."""
    panels = []
    for key, name in (("length_error_percent", "length error / %"), ("tilt_error_deg", "tilt error / °")):
        series = []
        for level, mode in enumerate(modes):
            mine = [row for row in rows if row["mode"] == mode and row.get(key) is not None]
            if not mine:
                continue
            size, look = mean_over_sweeps(mine, key), (label_of(mode), colour_of(mode, modes))
            spread = level + 0.3 * (np.arange(len(mine)) / max(len(mine) - 1, 1) - 0.5)
            points = np.column_stack([[row[key] for row in mine], spread])
            words = [f"{row['sweep']}, part {row['part']}" for row in mine]
            series.append(Series(*look, np.array([[-size, level], [size, level]]), "bar"))
            series.append(Series(*look, points, "points", words=words))
        panels.append(Panel(series, (name, ""), [label_of(mode) for mode in modes]))
    return panels


def outline_series(poses: Mapping[str, RigidTransform], grid: ImageGrid) -> list[Series]:
    """Outlines of some frames of every mode in space, shape (n, 3), mm, the reference first."""
    closed = grid.corners_mm[[0, 1, 2, 3, 0]]
    breaks = np.full((1, 3), np.nan)
    found = []
    for mode in sorted(poses, key=lambda name: name not in REFERENCES):
        frames = np.linspace(0, len(poses[mode]) - 1, min(len(poses[mode]), OUTLINES)).round().astype(int)
        lines = [np.concatenate([poses[mode][int(i)].apply(closed), breaks]) for i in np.unique(frames)]
        style: Style = "reference" if mode in REFERENCES else "line"
        found.append(Series(label_of(mode), colour_of(mode, list(poses)), np.concatenate(lines), style))
    return found


def rejected_panel(rejected: RejectedPatches) -> Panel:
    """Share of the patches that were left out, over the frames."""
    frames = decimated(rejected.frame_share.size)
    line = Series("", "#404040", np.column_stack([frames, 100.0 * rejected.frame_share[frames]]), "dotted")
    return Panel([line], ("frame", "patches left out / %"), limits=(0.0, 100.0))


def figure_overview(panels: Sequence[Panel]) -> Figure:
    """Draw `overview_panels` side by side."""
    return figure_panels(panels, 2, (9.0, 1.3 + 0.5 * len(panels[0].levels)))


def figure_outlines(series: Sequence[Series]) -> Figure:
    """Draw the outlines of every mode in space side by side, the reference's in grey behind each."""
    behind = [each for each in series if each.style == "reference"]
    shown = [each for each in series if each.style != "reference"]
    figure = new_figure(3.1 * len(shown), 3.5)
    everything = np.concatenate([each.points for each in series])
    extent = np.nanmax(everything, axis=0) - np.nanmin(everything, axis=0)
    for i, mode in enumerate(shown):
        axes: Any = figure.add_subplot(1, len(shown), i + 1, projection="3d")
        for each in (*behind, mode):
            colour = "0.55" if each in behind else each.colour
            axes.plot(*each.points[:, [2, 0, 1]].T, color=colour, linewidth=0.9)
        for axis, name in ((axes.xaxis, "elevational"), (axes.yaxis, "lateral"), (axes.zaxis, "depth")):
            axis.set_label_text(f"{name} / mm", fontsize="small")
            axis.set_major_locator(MaxNLocator(4))
        axes.set_title(wrapped(mode.label, 3.1), fontsize="medium", color=mode.colour, y=0.95)
        axes.set_box_aspect(np.maximum(extent, 0.15 * extent.max())[[2, 0, 1]], zoom=0.62)
        axes.tick_params(labelsize=6)
        axes.invert_zaxis()
        axes.view_init(elev=22, azim=-62)
    return figure


def figure_cuts(cuts: Cuts) -> Figure:
    """Reslices of all modes at one scale, each with its detail enlarged below."""
    modes = list(cuts.by_mode)
    widths = [max(cut.extent_mm[0], 0.45 * cut.extent_mm[1]) for cut in cuts.by_mode.values()]
    tall = max(cut.extent_mm[1] for cut in cuts.by_mode.values())
    scale = min(9.0 / sum(widths), 5.5 / tall)
    below = min(w * scale for w in widths) * 0.8
    figure = new_figure(max(scale * sum(widths) + 1.2, 5.0), scale * tall + below + 1.4, "compressed")
    panels = figure.subplots(2, len(modes), squeeze=False, width_ratios=widths,
                             height_ratios=[scale * tall, below])  # fmt: skip
    for i, (mode, cut) in enumerate(cuts.by_mode.items()):
        _draw_cut(panels[0, i], panels[1, i], cut)
        title = wrapped(label_of(mode), cut.extent_mm[0] * scale + 0.4)
        panels[0, i].set_title(title, fontsize="medium", color=colour_of(mode, modes))
        panels[0, i].set_anchor("N")
    panels[0, 0].set_ylabel("depth from the top / mm")
    panels[1, 0].set_ylabel("enlarged")
    figure.supxlabel("along the sweep / mm", fontsize="medium")
    return figure


def figure_rejected(rejected: RejectedPatches, cuts: Cuts | None, grid: ImageGrid) -> Figure:
    """Where in the image patches were left out, over an image of the sweep, and how many in each frame.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 4.
    """
    figure = new_figure(9.0, 4.0)
    image, sweep = figure.subplots(1, 2, width_ratios=[1.0, 1.5])
    if cuts is not None:
        right = (0.0, cuts.grid.width_mm, cuts.grid.depth_mm, cuts.grid.first_sample_depth_mm)
        image.imshow(
            cuts.middle.T, cmap="gray", extent=right, aspect="auto", vmin=0, vmax=255, rasterized=True
        )
    width, height = patch_size(rejected.centre_mm)
    corners = rejected.centre_mm - [width / 2, height / 2]
    boxes = PatchCollection(
        [Rectangle((x, y), width, height) for x, y in corners], cmap="viridis", alpha=0.55
    )
    boxes.set_array(np.ma.masked_invalid(100.0 * rejected.share))
    boxes.set_clim(0.0, 100.0)
    image.add_collection(boxes)
    image.set(xlim=(0.0, grid.width_mm), ylim=(grid.depth_mm, grid.first_sample_depth_mm), aspect="equal")
    figure.colorbar(boxes, ax=image, label="left out / % of the pairs")
    label_axes(image, "lateral / mm", "depth / mm")
    draw_panel(sweep, rejected_panel(rejected))
    return figure


def patch_size(centre_mm: FloatArray) -> tuple[float, float]:
    """Width and height of the patches from the distances between their centres, mm."""
    gaps = [np.diff(np.unique(np.round(column, 6))) for column in centre_mm.T]
    sides = [float(gap.min()) if gap.size else 3.0 for gap in gaps]
    return sides[0], sides[1]


def save_both(figure: Figure, stem: Path) -> bytes:
    """Write ``stem.png`` and ``stem.svg``, each whole or not at all; returns the SVG."""
    make_folder(stem.parent)
    figure.draw_without_rendering()
    # The layout is settled once, not for every format.
    figure.set_layout_engine("none")
    pictures = {kind: rendered(figure, kind) for kind in ("png", "svg")}
    for kind, picture in pictures.items():
        with atomic_path(stem.with_name(f"{stem.name}.{kind}")) as part:
            part.write_bytes(picture)
    return pictures["svg"]


def rendered(figure: Figure, kind: str, dots_per_inch: float = DOTS_PER_INCH) -> bytes:
    """Bytes of a figure as png, jpg or svg; the same for the same figure."""
    data = io.BytesIO()
    options: dict[str, Any] = {"pil_kwargs": {"quality": 72}} if kind == "jpg" else {}
    # No date and no random names: a report made again from the same study is the same file.
    metadata = {"Date": None} if kind == "svg" else None
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "speckle3d", "font.family": "sans-serif"}):
        figure.savefig(data, format=kind, dpi=dots_per_inch, metadata=metadata, **options)
    if kind != "svg":
        return data.getvalue()
    # A hundredth of a point is finer than any printer; six decimals are most of the file.
    return re.sub(rb"(\d\.\d\d)\d+", rb"\1", data.getvalue())


def _draw_cut(above: Axes, below: Axes, cut: Cut) -> None:
    width, height = cut.extent_mm
    left, top = cut.corner_mm
    show_grey(above, cut.image, (0.0, width, height, 0.0), (0, 255))
    above.add_patch(Rectangle((left, top), *cut.size_mm, fill=False, edgecolor=_DETAIL_COLOUR))
    show_grey(below, cut.detail, (left, left + cut.size_mm[0], top + cut.size_mm[1], top), (0, 255))
    below.tick_params(labelsize="small")
    for spine in below.spines.values():
        spine.set(color=_DETAIL_COLOUR, linewidth=2)
