"""The report's figures as plotly draws them where scripts run: to turn, enlarge and read off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from plotly import graph_objects as go
from plotly.colors import hex_to_rgb
from plotly.subplots import make_subplots

from speckle3d.report.data import RejectedPatches
from speckle3d.report.figures import rejected_panel
from speckle3d.study.figures import Panel, Series

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
        figure.update_yaxes(autorange="reversed", automargin=True, **ticks)
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
    scene: dict[str, Any] = {
        f"{axis}axis": {"title": {"text": name}} for axis, name in zip("xyz", names, strict=True)
    }
    scene["zaxis"]["autorange"] = "reversed"
    scene |= {"aspectmode": "data", "camera": {"eye": {"x": 1.7, "y": -2.4, "z": 1.2}}}
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
        x=_numbers(across),
        y=_numbers(down),
        z=_numbers(table),
        zmin=0,
        zmax=100,
        colorscale="Viridis",
        colorbar={"title": {"text": "left out / %"}, "x": 0.34, "thickness": 14},
        hovertemplate="lateral %{x:.1f} mm, depth %{y:.1f} mm: %{z:.0f} %<extra></extra>",
        row=1,
        col=1,
    )
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
                marker_color=each.colour, text=list(each.words),
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
