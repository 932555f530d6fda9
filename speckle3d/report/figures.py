"""The report's figures: what is drawn, and by plotly, how. They can be turned, enlarged and read off."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from plotly import graph_objects as go
from plotly.colors import hex_to_rgb
from plotly.subplots import make_subplots
from scipy.spatial.transform import RigidTransform

from speckle3d.core.sweep import ImageGrid
from speckle3d.report.data import Record, RejectedPatches
from speckle3d.study.figures import Panel, Series, colour_of, label_of
from speckle3d.study.overall import words_of

MOST_POINTS = 240
"""Points of a curve: more than print or screen resolve, and each costs bytes."""

OUTLINES = 20
"""Frames whose outlines are drawn."""

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
    for key in ("length_error_percent", "tilt_error_deg"):
        series = []
        for level, mode in enumerate(modes):
            own = [row for row in rows if row["mode"] == mode and row[key] is not None]
            if not own:
                continue
            size = float(np.mean([abs(row[key]) for row in own]))
            look = label_of(mode), colour_of(mode, modes)
            spread = level + 0.3 * (np.arange(len(own)) / max(len(own) - 1, 1) - 0.5)
            points = np.column_stack([[row[key] for row in own], spread])
            words = [f"{row['sweep']}, part {row['part']}" for row in own]
            series.append(Series(*look, np.array([[-size, level], [size, level]]), "bar"))
            series.append(Series(*look, points, "points", words=words))
        panels.append(Panel(series, (words_of(key), ""), [label_of(mode) for mode in modes]))
    return panels


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
        return figure.update_yaxes(autorange="reversed", automargin=True, zeroline=False, **ticks)
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


def plot_outlines(poses: Mapping[str, RigidTransform], grid: ImageGrid) -> go.Figure:
    """Outlines of some frames of every mode in space, the first frames laid on each other.

    Modes come and go by the legend; the truth is broad, so that the others lie on it.
    """
    figure = go.Figure(layout=_LAYOUT)
    closed, breaks = grid.corners_mm[[0, 1, 2, 3, 0]], np.full((1, 3), np.nan)
    for mode in sorted(poses, key=lambda name: name != "truth"):
        laid = poses[mode][0].inv() * poses[mode]
        frames = np.unique(np.linspace(0, len(laid) - 1, min(len(laid), OUTLINES)).round().astype(int))
        line = np.concatenate([part for i in frames for part in (laid[int(i)].apply(closed), breaks)])
        x, y, z = (_numbers(line[:, axis]) for axis in (2, 0, 1))
        look = {"color": colour_of(mode, list(poses)), "width": 6 if mode == "truth" else 3}
        figure.add_scatter3d(
            x=x, y=y, z=z, mode="lines", name=label_of(mode), line=look, hoverinfo="name",
            opacity=0.4 if mode == "truth" else 1.0,
        )  # fmt: skip
    names = ("elevational / mm", "lateral / mm", "depth / mm")
    scene: dict[str, Any] = {"aspectmode": "data", "camera": {"eye": {"x": 1.7, "y": -2.4, "z": 1.2}}}
    scene |= {f"{axis}axis": {"title": {"text": name}} for axis, name in zip("xyz", names, strict=True)}
    scene["zaxis"]["autorange"] = "reversed"
    return figure.update_layout(scene=scene, legend={"orientation": "h"}, height=520)


def plot_rejected(rejected: RejectedPatches) -> go.Figure:
    """Share of the pairs in which each patch was left out, and of the patches over the sweep.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 4.
    """
    centres = np.round(rejected.centre_mm, 6)
    (across, column), (down, row) = (np.unique(each, return_inverse=True) for each in centres.T)
    table = np.full((down.size, across.size), np.nan)
    table[row, column] = 100.0 * rejected.share
    frames = decimated(rejected.frame_share.size)
    line = Series("", "#404040", np.column_stack([frames, 100.0 * rejected.frame_share[frames]]), "dotted")
    figure = make_subplots(1, 2, column_widths=[0.4, 0.6], horizontal_spacing=0.18)
    figure.update_layout(_LAYOUT, height=400, showlegend=False)
    figure.add_heatmap(
        x=_numbers(across), y=_numbers(down), z=_numbers(table), zmin=0, zmax=100, colorscale="Viridis",
        colorbar={"title": {"text": "left out / %"}, "x": 0.34, "thickness": 14},
        hovertemplate="lateral %{x:.1f} mm, depth %{y:.1f} mm: %{z:.0f} %<extra></extra>",
        row=1, col=1,
    )  # fmt: skip
    figure.add_trace(_traces(Panel([line], ("", "")), named=False)[0], 1, 2)
    figure.update_xaxes(title_text="lateral / mm", row=1, col=1)
    figure.update_yaxes(title_text="depth / mm", autorange="reversed", row=1, col=1)
    figure.update_xaxes(title_text="frame", row=1, col=2)
    return figure.update_yaxes(title_text="patches left out / %", range=(0.0, 100.0), row=1, col=2)


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
        trace.update({f"{'marker' if each.style == 'points' else 'line'}_color": each.colour})
        if each.style == "points":
            unit = panel.axes[0].rpartition(" / ")[2]
            words = [html.escape(word, quote=False) for word in each.words]
            trace.update(text=words, hovertemplate="%{text}: %{x:.2f} " + unit + "<extra></extra>")
        elif each.style != "bar":
            trace.update(line_dash=_DASHES[each.dash % len(_DASHES)], hovertemplate="%{y:.2f}")
        traces.append(trace)
    return traces


def _numbers(values: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Values as plotly writes them shortest."""
    return np.asarray(values, dtype=np.float32)
