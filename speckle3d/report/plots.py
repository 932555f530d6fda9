"""The report's interactive plots, as the plain data that plotly.js draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.sweep import ImageGrid
from speckle3d.report.data import QUANTITIES, RejectedPatches, SweepCurves
from speckle3d.report.figures import CURVE_LABELS, colour_of, decimated, label_of, outline
from speckle3d.study.job import REFERENCES
from speckle3d.study.overall import mean_over_sweeps

Plot = dict[str, Any]

_DASHES = ("solid", "dash", "dashdot", "dot", "longdash")
_DOMAINS = tuple((across, up) for up in ((0.57, 1.0), (0.0, 0.43)) for across in ((0.0, 0.45), (0.55, 1.0)))
"""Of the four curves' panels: horizontal, vertical."""


def plot_overview(rows: Sequence[Mapping[str, Any]], modes: Sequence[str]) -> Plot:
    """Errors of length and tilt of every part of every sweep, named under the pointer."""
    traces = []
    for i, (key, unit) in enumerate((("length_error_percent", " %"), ("tilt_error_deg", " °"))):
        for mode in modes:
            mine = [row for row in rows if row["mode"] == mode and row.get(key) is not None]
            size = mean_over_sweeps(mine, key) if mine else 0.0
            traces.append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "x": [-size, size],
                    "y": [label_of(mode)] * 2,
                    "line": {"color": colour_of(mode, modes), "width": 10},
                    "opacity": 0.25,
                    "hoverinfo": "skip",
                    "xaxis": f"x{i + 1}",
                    "yaxis": f"y{i + 1}",
                }
            )
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "x": [row[key] for row in mine],
                    "y": [label_of(mode)] * len(mine),
                    "text": [f"{row['sweep']}, part {row['part']}" for row in mine],
                    "hovertemplate": "%{text}: %{x:.2f}" + unit + "<extra></extra>",
                    "marker": {"color": colour_of(mode, modes), "size": 9, "opacity": 0.65},
                    "xaxis": f"x{i + 1}",
                    "yaxis": f"y{i + 1}",
                }
            )
    layout = {
        "showlegend": False,
        "xaxis": {"title": {"text": "length error / %"}, "domain": [0.0, 0.47], "anchor": "y"},
        "xaxis2": {"title": {"text": "tilt error / °"}, "domain": [0.53, 1.0], "anchor": "y2"},
        "yaxis": {"autorange": "reversed", "automargin": True, "anchor": "x"},
        "yaxis2": {"autorange": "reversed", "showticklabels": False, "anchor": "x2"},
    }
    return _plot(traces, layout, 140 + 50 * len(modes))


def plot_curves(curves: SweepCurves) -> Plot:
    """Accumulated length, tilt, yaw and roll; with a reference, also as differences from it."""
    traces: list[Plot] = []
    absolute: list[bool] = []
    for subtract in (False, True) if curves.reference is not None else (False,):
        for q in range(len(QUANTITIES)):
            added = _panel_traces(curves, q, subtract)
            traces += added
            absolute += [not subtract] * len(added)
    for trace, shown in zip(traces, absolute, strict=True):
        trace["visible"] = shown
    layout: Plot = {"legend": {"orientation": "h", "y": 1.12}, "hovermode": "x unified"}
    for q, (across, up) in enumerate(_DOMAINS):
        layout[f"xaxis{q + 1}"] = {
            "domain": across,
            "anchor": f"y{q + 1}",
            "matches": "x" if q else None,
            "title": {"text": "frame" if q > 1 else ""},
        }
        layout[f"yaxis{q + 1}"] = {"domain": up, "anchor": f"x{q + 1}", "title": {"text": CURVE_LABELS[q]}}
    if curves.reference is not None:
        layout["updatemenus"] = [_choice(absolute, curves.reference_name)]
    return _plot(traces, layout, 620)


def plot_outlines(poses: Mapping[str, RigidTransform], grid: ImageGrid) -> Plot:
    """Outlines of the frames in space, seen from the first frame; modes come and go by the legend."""
    traces = []
    # The reference first and broad and grey: the modes lie on it, not under it.
    for mode in sorted(poses, key=lambda name: name not in REFERENCES):
        line = outline(poses[mode], grid)
        is_reference = mode in REFERENCES
        traces.append(
            {
                "type": "scatter3d",
                "mode": "lines",
                "name": label_of(mode),
                "x": _numbers(line[:, 2]),
                "y": _numbers(line[:, 0]),
                "z": _numbers(line[:, 1]),
                "line": {
                    "color": "#9aa0a8" if is_reference else colour_of(mode, list(poses)),
                    "width": 6 if is_reference else 3,
                },
                "connectgaps": False,
                "hoverinfo": "name",
            }
        )
    names = ("elevational / mm", "lateral / mm", "depth / mm")
    scene: Plot = {f"{axis}axis": {"title": {"text": name}} for axis, name in zip("xyz", names, strict=True)}
    scene["zaxis"]["autorange"] = "reversed"
    scene |= {"aspectmode": "data", "camera": {"eye": {"x": 1.7, "y": -2.4, "z": 1.2}}}
    return _plot(traces, {"scene": scene, "legend": {"orientation": "h"}}, 520)


def plot_rejected(rejected: RejectedPatches) -> Plot:
    """Share of the pairs in which each patch was left out, and of the patches over the sweep."""
    across, down = (np.unique(np.round(column, 6)) for column in rejected.centre_mm.T)
    table = np.full((down.size, across.size), np.nan)
    columns = np.searchsorted(across, np.round(rejected.centre_mm[:, 0], 6))
    table[np.searchsorted(down, np.round(rejected.centre_mm[:, 1], 6)), columns] = 100.0 * rejected.share
    frames = decimated(rejected.frame_share.size)
    heat = {
        "type": "heatmap",
        "x": _numbers(across),
        "y": _numbers(down),
        "z": [_numbers(row) for row in table],
        "zmin": 0,
        "zmax": 100,
        "colorscale": "Viridis",
        "colorbar": {"title": {"text": "left out / %"}, "x": 0.36, "thickness": 14},
        "hovertemplate": "lateral %{x:.1f} mm, depth %{y:.1f} mm: %{z:.0f} %<extra></extra>",
    }
    line = {
        "type": "scatter",
        "x": frames.tolist(),
        "y": _numbers(100.0 * rejected.frame_share[frames]),
        "mode": "lines+markers",
        "marker": {"size": 4},
        "line": {"color": "#444", "width": 1},
        "xaxis": "x2",
        "yaxis": "y2",
        "hovertemplate": "frame %{x}: %{y:.0f} %<extra></extra>",
    }
    layout = {
        "showlegend": False,
        "xaxis": {"title": {"text": "lateral / mm"}, "domain": [0.0, 0.35], "anchor": "y"},
        "yaxis": {"title": {"text": "depth / mm"}, "autorange": "reversed"},
        "xaxis2": {"title": {"text": "frame"}, "domain": [0.53, 1.0], "anchor": "y2"},
        "yaxis2": {"title": {"text": "patches left out / %"}, "range": [0, 100], "anchor": "x2"},
    }
    return _plot([heat, line], layout, 400)


def _panel_traces(curves: SweepCurves, q: int, subtract: bool) -> list[Plot]:
    frames = decimated(curves.frames)
    zero = curves.reference[q] if subtract and curves.reference is not None else np.zeros(curves.frames)
    axes = {
        "xaxis": f"x{q + 1}",
        "yaxis": f"y{q + 1}",
        "showlegend": q == 0,
        "type": "scatter",
        "mode": "lines",
        "x": frames.tolist(),
        "hovertemplate": "%{y:.2f}",
    }
    traces: list[Plot] = []
    if curves.reference is not None:
        style = {"color": "rgba(0,0,0,0.5)", "width": 4}
        traces.append(
            {
                **axes,
                "name": curves.reference_name,
                "y": _numbers((curves.reference[q] - zero)[frames]),
                "line": style,
                "legendgroup": "reference",
            }
        )
    if curves.half_width is not None:
        middle = curves.modes["image"][q] - zero
        traces += _band(
            axes, (middle - curves.half_width[q])[frames], (middle + curves.half_width[q])[frames]
        )
    for i, (mode, values) in enumerate(curves.modes.items()):
        line = {"color": colour_of(mode, list(curves.modes)), "width": 1.8, "dash": _DASHES[i % len(_DASHES)]}
        traces.append(
            {
                **axes,
                "name": label_of(mode),
                "y": _numbers((values[q] - zero)[frames]),
                "line": line,
                "legendgroup": mode,
            }
        )
    return traces


def _band(axes: Plot, low: npt.NDArray[Any], high: npt.NDArray[Any]) -> list[Plot]:
    shared = {**axes, "line": {"width": 0}, "hoverinfo": "skip", "legendgroup": "band"}
    shared.pop("hovertemplate")
    name = f"95 % of {label_of('image')}"
    return [
        {**shared, "y": _numbers(low), "showlegend": False, "name": name},
        {**shared, "y": _numbers(high), "fill": "tonexty", "fillcolor": "rgba(213,94,0,0.16)", "name": name},
    ]


def _choice(absolute: Sequence[bool], reference: str) -> Plot:
    buttons = [
        {"label": text, "method": "restyle", "args": [{"visible": [shown == first for shown in absolute]}]}
        for text, first in (("accumulated", True), (f"minus {reference}", False))
    ]
    return {
        "type": "buttons",
        "direction": "right",
        "x": 0,
        "xanchor": "left",
        "y": 1.2,
        "yanchor": "bottom",
        "showactive": True,
        "buttons": buttons,
    }


def _plot(traces: list[Plot], layout: Plot, height: int) -> Plot:
    common = {
        "height": height,
        "margin": {"l": 60, "r": 20, "t": 60 if "updatemenus" in layout else 20, "b": 50},
        "paper_bgcolor": "#fff",
        "plot_bgcolor": "#fff",
        "font": {"family": "system-ui, sans-serif", "size": 13},
    }
    return {"data": traces, "layout": common | layout}


def _numbers(values: npt.NDArray[Any]) -> list[float | None]:
    """Turn values to what JSON holds: three decimals (micrometres), null where there is none."""
    return [round(float(v), 3) if np.isfinite(v) else None for v in values]
