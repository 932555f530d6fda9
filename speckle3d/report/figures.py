"""The report's figures: what is drawn, and how, twice: by matplotlib for print, by plotly where scripts run.

matplotlib's are PNG, SVG and JPEG files; plotly's can be turned, enlarged and read off.
"""

from __future__ import annotations

import html
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
from plotly import graph_objects as go
from plotly.colors import hex_to_rgb
from plotly.subplots import make_subplots
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import ImageGrid
from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.report.data import Cut, Cuts, Record, RejectedPatches
from speckle3d.scoring.references import REFERENCES
from speckle3d.study.figures import (
    DOTS_PER_INCH,
    Panel,
    Series,
    Style,
    colour_of,
    draw_panel,
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

_DASHES = ("solid", "dash", "dashdot", "dot", "longdash")
_LOOKS: Mapping[str, Mapping[str, Any]] = {
    "line": {"mode": "lines", "line": {"width": 1.8}},
    "reference": {"mode": "lines", "line": {"width": 4}, "opacity": 0.5},
    "points": {"mode": "markers", "marker": {"size": 9}, "opacity": 0.65},
    "dotted": {"mode": "lines+markers", "line": {"width": 1}, "marker": {"size": 4}},
    "bar": {"mode": "lines", "line": {"width": 10}, "opacity": 0.25, "hoverinfo": "skip"},
}
_LAYOUT: Mapping[str, Any] = {
    "template": "none",
    "font": {"family": "system-ui, sans-serif", "size": 13},
    "margin": {"l": 60, "r": 20, "t": 20, "b": 50},
}


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
    size = patch_size(rejected.centre_mm)
    corners = rejected.centre_mm - np.divide(size, 2)
    boxes = PatchCollection([Rectangle(corner, *size) for corner in corners], cmap="viridis", alpha=0.55)
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
    width, height = (float(gap.min()) if gap.size else 3.0 for gap in gaps)
    return width, height


def save_both(figure: Figure, stem: Path) -> bytes:
    """Write ``stem.png`` and ``stem.svg``, each whole or not at all; returns the SVG."""
    make_folder(stem.parent)
    figure.draw_without_rendering()
    # The layout is settled once, not for every format.
    figure.set_layout_engine("none")
    for kind in ("png", "svg"):
        picture = rendered(figure, kind)
        with atomic_path(stem.with_name(f"{stem.name}.{kind}")) as part:
            part.write_bytes(picture)
    return picture


def rendered(figure: Figure, kind: str, dots_per_inch: float = DOTS_PER_INCH) -> bytes:
    """Bytes of a figure as png, jpg or svg; the same for the same figure."""
    data = io.BytesIO()
    # No date and no random names: a report made again from the same study is the same file.
    options: dict[str, Any] = {"jpg": {"pil_kwargs": {"quality": 72}}, "svg": {"metadata": {"Date": None}}}
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "speckle3d", "font.family": "sans-serif"}):
        figure.savefig(data, format=kind, dpi=dots_per_inch, **options.get(kind, {}))
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


def plot_panels(views: Mapping[str, Sequence[Panel]], columns: int, height: int) -> go.Figure:
    """Panels in rows of `columns`.

    Parameters
    ----------
    views : mapping of str to sequence of Panel
        By the name of the button that shows them, the first at once; a single view has no button.
    height : int
        Pixels.
    """
    first, *_ = views.values()
    rows, levels = -(-len(first) // columns), first[0].levels
    figure = make_subplots(
        rows, columns, shared_xaxes="all" if rows > 1 else False, shared_yaxes=bool(levels),
        horizontal_spacing=0.08, vertical_spacing=0.12,
    )  # fmt: skip
    figure.update_layout(
        _LAYOUT, height=height, showlegend=not levels, legend={"orientation": "h", "y": 1.12}
    )
    shown: list[str] = []
    for view, panels in views.items():
        for i, panel in enumerate(panels):
            for trace in _traces(panel, named=i == 0):
                trace.visible = view == next(iter(views))
                figure.add_trace(trace, i // columns + 1, i % columns + 1)
                shown.append(view)
    for i, panel in enumerate(first):
        place = {"row": i // columns + 1, "col": i % columns + 1}
        figure.update_xaxes(title_text=panel.axes[0] if i + columns >= len(first) else "", **place)
        figure.update_yaxes(title_text=panel.axes[1], **place)
    if levels:
        ticks = {"tickvals": list(range(len(levels))), "ticktext": list(levels)}
        figure.update_yaxes(autorange="reversed", automargin=True, zeroline=False, **ticks)
    else:
        figure.update_layout(hovermode="x unified")
    if len(views) > 1:
        buttons = [
            {"label": view, "method": "restyle", "args": [{"visible": [each == view for each in shown]}]}
            for view in views
        ]
        menu = {"type": "buttons", "direction": "right", "x": 0, "xanchor": "left", "y": 1.2,
                "yanchor": "bottom", "buttons": buttons}  # fmt: skip
        figure.update_layout(updatemenus=[menu], margin_t=60)
    return figure


def plot_outlines(series: Sequence[Series]) -> go.Figure:
    """Outlines of the frames in space, seen from the first frame; modes come and go by the legend."""
    figure = go.Figure(layout=_LAYOUT)
    for each in series:
        # The reference is broad and grey: the modes lie on it, not under it.
        behind = each.style == "reference"
        line = {"color": "#9aa0a8" if behind else each.colour, "width": 6 if behind else 3}
        x, y, z = (_numbers(each.points[:, axis]) for axis in (2, 0, 1))
        figure.add_scatter3d(x=x, y=y, z=z, mode="lines", name=each.label, line=line, hoverinfo="name")
    names = ("elevational / mm", "lateral / mm", "depth / mm")
    scene: dict[str, Any] = {"aspectmode": "data", "camera": {"eye": {"x": 1.7, "y": -2.4, "z": 1.2}}}
    scene |= {f"{axis}axis": {"title": {"text": name}} for axis, name in zip("xyz", names, strict=True)}
    scene["zaxis"]["autorange"] = "reversed"
    return figure.update_layout(scene=scene, legend={"orientation": "h"}, height=520)


def plot_rejected(rejected: RejectedPatches) -> go.Figure:
    """Share of the pairs in which each patch was left out, and of the patches over the sweep."""
    centres = np.round(rejected.centre_mm, 6)
    (across, column), (down, row) = (np.unique(each, return_inverse=True) for each in centres.T)
    table = np.full((down.size, across.size), np.nan)
    table[row, column] = 100.0 * rejected.share
    panel = rejected_panel(rejected)
    figure = make_subplots(1, 2, column_widths=[0.4, 0.6], horizontal_spacing=0.18)
    figure.update_layout(_LAYOUT, height=400, showlegend=False)
    figure.add_heatmap(
        x=_numbers(across), y=_numbers(down), z=_numbers(table), zmin=0, zmax=100, colorscale="Viridis",
        colorbar={"title": {"text": "left out / %"}, "x": 0.34, "thickness": 14},
        hovertemplate="lateral %{x:.1f} mm, depth %{y:.1f} mm: %{z:.0f} %<extra></extra>",
        row=1, col=1,
    )  # fmt: skip
    for trace in _traces(panel, named=False):
        figure.add_trace(trace, 1, 2)
    figure.update_xaxes(title_text="lateral / mm", row=1, col=1)
    figure.update_yaxes(title_text="depth / mm", autorange="reversed", row=1, col=1)
    figure.update_xaxes(title_text=panel.axes[0], row=1, col=2)
    return figure.update_yaxes(title_text=panel.axes[1], range=panel.limits, row=1, col=2)


def _traces(panel: Panel, named: bool) -> list[go.Scatter]:
    """What draws a panel's series; `named` in the legend."""
    traces = []
    for each in panel.series:
        x, y = (_numbers(column) for column in each.points.T)
        shared = {"x": x, "name": each.label, "legendgroup": each.label}
        if each.low is not None:
            faint = f"rgba{(*hex_to_rgb(each.colour), 0.16)}"
            edge = {**shared, "mode": "lines", "line": {"width": 0}, "hoverinfo": "skip"}
            traces.append(go.Scatter(y=_numbers(each.low), showlegend=False, **edge))
            traces.append(go.Scatter(y=y, fill="tonexty", fillcolor=faint, showlegend=named, **edge))
            continue
        trace = go.Scatter(y=y, showlegend=named, **shared, **_LOOKS[each.style])
        if each.style == "points":
            unit = panel.axes[0].rpartition(" / ")[2]
            trace.update(
                marker_color=each.colour, text=[html.escape(word, quote=False) for word in each.words],
                hovertemplate="%{text}: %{x:.2f} " + unit + "<extra></extra>",
            )  # fmt: skip
        elif each.style == "bar":
            trace.update(line_color=each.colour)
        else:
            dash = _DASHES[each.dash % len(_DASHES)]
            trace.update(line_color=each.colour, line_dash=dash, hovertemplate="%{y:.2f}")
        traces.append(trace)
    return traces


def _numbers(values: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Values as plotly writes them shortest."""
    return np.asarray(values, dtype=np.float32)
