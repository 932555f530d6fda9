"""The report's figures: the overview by matplotlib for a file too; the others by plotly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from plotly import graph_objects as go
from plotly.colors import hex_to_rgb
from plotly.subplots import make_subplots
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import AnyArray, Float32Array, FloatArray
from speckle3d.core.grid import ImageGrid
from speckle3d.core.images import spread_frames
from speckle3d.core.reconstruction import FramePairs
from speckle3d.imaging.images import image_outline
from speckle3d.scoring.references import SweepCurves
from speckle3d.study.figures import CURVE_LABELS, colour_of, label_of, new_figure
from speckle3d.study.overall import Row, words_of

MOST_POINTS = 240
"""Points of a curve: more than print or screen resolve, and each costs bytes."""

OUTLINES = 20
"""Frames whose outlines are drawn."""

_DASHES = ("solid", "dash", "dashdot", "dot", "longdash")
_LAYOUT: Mapping[str, Any] = {
    "template": "none",
    "font": {"family": "system-ui, sans-serif", "size": 13},
    "margin": {"l": 60, "r": 20, "t": 20, "b": 50},
}


def draw_overview(rows: Sequence[Row], modes: Sequence[str], title: str) -> Figure:
    """Draw errors of length and tilt: a point for every part of every sweep, a bar at the mean magnitude."""
    figure = new_figure(9.0, 1.8 + 0.5 * len(modes))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, key in zip(panels, ("length_error_percent", "tilt_error_deg"), strict=True):
        axes.axvline(0.0, color="0.6", linewidth=0.8)
        for level, mode in enumerate(modes):
            errors = np.array([row[key] for row in rows if row["mode"] == mode and np.isfinite(row[key])])
            if errors.size:
                colour, size = colour_of(mode), np.abs(errors).mean()
                spread = level + 0.3 * np.linspace(-0.5, 0.5, errors.size) * (errors.size > 1)
                axes.plot([-size, size], [level, level], color=colour, linewidth=6, alpha=0.25)
                axes.plot(errors, spread, "o", color=colour, markersize=4, alpha=0.7)
        axes.set_xlabel(words_of(key))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(visible=True, alpha=0.3)
    panels[0].set_yticks(range(len(modes)), [label_of(mode) for mode in modes])
    panels[0].invert_yaxis()
    figure.suptitle(title)
    return figure


def plot_curves(curves: SweepCurves) -> go.Figure:
    """Length, tilt, yaw and roll over the frames, of every mode and the reference.

    With a reference, a button shows differences from it.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 6.
    """
    figure = make_subplots(2, 2, shared_xaxes="all", horizontal_spacing=0.08, vertical_spacing=0.12)
    figure.update_layout(_LAYOUT, height=620, hovermode="x unified", legend={"orientation": "h", "y": 1.12})
    views: dict[str, FloatArray] = {"accumulated": np.zeros((len(CURVE_LABELS), curves.frames))}
    if curves.reference is not None:
        views[f"minus {curves.reference_name}"] = curves.reference
    trace_views: list[str] = []
    for view, zero in views.items():
        for q, label in enumerate(CURVE_LABELS):
            place = {"row": q // 2 + 1, "col": q % 2 + 1}
            for trace in _curve_traces(curves, q, zero):
                figure.add_trace(trace.update(visible=view == "accumulated"), **place)
                trace_views.append(view)
            figure.update_xaxes(title_text="frame" if q > 1 else "", **place)
            figure.update_yaxes(title_text=label, **place)
    buttons = [
        {"label": name, "method": "restyle", "args": [{"visible": [view == name for view in trace_views]}]}
        for name in views
    ]
    if len(views) > 1:
        menu = {"type": "buttons", "direction": "right", "x": 0, "xanchor": "left", "y": 1.2,
                "yanchor": "bottom", "buttons": buttons}  # fmt: skip
        figure.update_layout(updatemenus=[menu], margin_t=60)
    return figure


def _curve_traces(curves: SweepCurves, q: int, zero: FloatArray) -> list[go.Scatter]:
    """One quantity of the reference and of all modes, less `zero`; named in the legend once."""
    frames = spread_frames(curves.frames, MOST_POINTS)

    def trace(values: FloatArray, name: str, line: dict[str, Any], **look: Any) -> go.Scatter:
        look = {"showlegend": q == 0, "legendgroup": name, "mode": "lines", **look}
        return go.Scatter(x=frames, y=_numbers((values - zero)[q, frames]), name=name, line=line, **look)

    traces = []
    if curves.reference is not None:
        name = curves.reference_name
        traces.append(trace(curves.reference, name, {"width": 4, "color": colour_of(name)}))
    if curves.half_width is not None:
        name, middle, half = "95 % interval of image", curves.modes["image"], curves.half_width
        faint = f"rgba{(*hex_to_rgb(colour_of('image')), 0.16)}"
        traces.append(trace(middle - half, name, {"width": 0}, hoverinfo="skip", showlegend=False))
        band = {"fill": "tonexty", "fillcolor": faint, "hoverinfo": "skip"}
        traces.append(trace(middle + half, name, {"width": 0}, **band))
    for i, mode in enumerate(curves.modes):
        line = {"width": 1.8, "dash": _DASHES[i % len(_DASHES)], "color": colour_of(mode)}
        traces.append(trace(curves.modes[mode], label_of(mode), line, hovertemplate="%{y:.2f}"))
    return traces


def plot_outlines(poses: Mapping[str, RigidTransform], grid: ImageGrid) -> go.Figure:
    """Outlines of some frames of every mode in space, the first frames laid on each other.

    Modes come and go by the legend; the truth is broad, so that the others lie on it.
    """
    figure = go.Figure(layout=_LAYOUT)
    outline, breaks = image_outline(grid), np.full((1, 3), np.nan)
    for mode in sorted(poses, key=lambda name: name != "truth"):
        path = poses[mode][0].inv() * poses[mode]
        frames = spread_frames(len(path), OUTLINES)
        line = np.concatenate([part for i in frames for part in (path[int(i)].apply(outline), breaks)])
        x, y, z = (_numbers(line[:, axis]) for axis in (2, 0, 1))
        look = {"color": colour_of(mode), "width": 6 if mode == "truth" else 3}
        figure.add_scatter3d(
            x=x, y=y, z=z, mode="lines", name=label_of(mode), line=look, hoverinfo="name",
            opacity=0.4 if mode == "truth" else 1.0,
        )  # fmt: skip
    names = ("elevational / mm", "lateral / mm", "depth / mm")
    scene: dict[str, Any] = {"aspectmode": "data", "camera": {"eye": {"x": 1.7, "y": -2.4, "z": 1.2}}}
    scene |= {f"{axis}axis": {"title": {"text": name}} for axis, name in zip("xyz", names, strict=True)}
    scene["zaxis"]["autorange"] = "reversed"
    return figure.update_layout(scene=scene, legend={"orientation": "h"}, height=520)


def plot_rejections(pairs: FramePairs, frames: int) -> go.Figure:
    """Share of the frame pairs in which each patch was left out, and of the patches in each frame.

    A pair's patches are those of its first frame.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 4.
    """
    distances = np.isfinite(pairs.distance_mm)
    left_out = distances & ~pairs.used
    share = _percent(left_out.sum(axis=0), distances.sum(axis=0))
    counts = [np.bincount(pairs.first, mask.sum(axis=1), frames) for mask in (left_out, distances)]
    by_frame = _percent(counts[0], counts[1])
    centres = np.round(pairs.patch_centre_mm, 6)
    (across, column), (down, row) = (np.unique(places, return_inverse=True) for places in centres.T)
    table = np.full((down.size, across.size), np.nan)
    table[row, column] = share
    figure = make_subplots(1, 2, column_widths=[0.4, 0.6], horizontal_spacing=0.18)
    figure.update_layout(_LAYOUT, height=400, showlegend=False)
    figure.add_heatmap(
        x=_numbers(across), y=_numbers(down), z=_numbers(table), zmin=0, zmax=100, colorscale="Viridis",
        colorbar={"title": {"text": "left out / %"}, "x": 0.34, "thickness": 14},
        hovertemplate="lateral %{x:.1f} mm, depth %{y:.1f} mm: %{z:.0f} %<extra></extra>",
        row=1, col=1,
    )  # fmt: skip
    at = spread_frames(frames, MOST_POINTS)
    look = {"mode": "lines+markers", "line": {"width": 1, "color": "#404040"}, "marker": {"size": 4}}
    figure.add_scatter(x=_numbers(at), y=_numbers(by_frame[at]), row=1, col=2, **look)
    figure.update_xaxes(title_text="lateral / mm", row=1, col=1)
    figure.update_yaxes(title_text="depth / mm", autorange="reversed", row=1, col=1)
    figure.update_xaxes(title_text="frame", row=1, col=2)
    return figure.update_yaxes(title_text="patches left out / %", range=(0.0, 100.0), row=1, col=2)


def _percent(part: AnyArray, whole: AnyArray) -> FloatArray:
    """Shares in per cent; NaN of nothing."""
    return 100.0 * part / np.where(whole > 0, whole, np.nan)


def _numbers(values: npt.ArrayLike) -> Float32Array:
    """Values as plotly writes them shortest."""
    return np.asarray(values, dtype=np.float32)
