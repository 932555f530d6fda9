"""Trajectories of all modes in space, all from the first frame's place, with their 95 % bands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from plotly import graph_objects as go
from plotly.colors import hex_to_rgb
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from speckle3d.app.reconstruction.cuts.cut_plot import DEPTH, FRAME, FREE, LATERAL
from speckle3d.app.reconstruction.cuts.material import Material
from speckle3d.app.reconstruction.cuts.shown import Name
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.imaging.cuts.outlines import frame_outlines
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.study.figures import colour_of, label_of

RADIUS_95 = float(np.sqrt(chi2.ppf(0.95, 3)))
"""Deviations within which 95 % of points in space lie."""
PLANE_COLOURS: dict[Name, str] = {"along": LATERAL, "frame": FRAME, "depth": DEPTH, "free": FREE}

_OUTLINES, _RINGS, _SIDES = 12, 40, 12
_AXES = [0, 2, 1]
"""Of the first frame: lateral, along the sweep, and depth, which is drawn downwards."""


def figure_space(
    material: Material, modes: Sequence[str], frame: int, planes: dict[Name, ReslicePlane]
) -> go.Figure:
    """Draw trajectories and bands of all modes, frames of some, and where the cuts are.

    Parameters
    ----------
    material : Material
    modes : sequence of str
        Whose frames are drawn; the first one's world is that of the planes.
    frame : int
        Drawn thick.
    planes : dict of str to ReslicePlane
    """
    figure = go.Figure()
    for mode in material.modes:
        for trace in _traces(material, mode, mode in modes, frame):
            figure.add_trace(trace)
    first = material.opened(modes[0]).poses[modes[0]][0].inv()
    for name, plane in planes.items():
        corners = first.apply(plane.hull_mm)[[0, 1, 3, 2, 0]]
        look = {"color": PLANE_COLOURS[name], "width": 5 if name == "free" else 3}
        figure.add_trace(_line(corners, line=look, showlegend=False, hoverinfo="skip"))
    scene = {
        "xaxis": {"title": {"text": "lateral / mm"}, "nticks": 4},
        "yaxis": {"title": {"text": "along / mm"}, "nticks": 4},
        "zaxis": {"title": {"text": "depth / mm"}, "autorange": "reversed"},
        "aspectmode": "data",
        "camera": {"eye": {"x": 1.7, "y": -2.1, "z": 0.6}},
    }
    figure.update_layout(
        template="none",
        scene=scene,
        uirevision="kept",
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        font={"family": "system-ui, sans-serif", "size": 10},
        legend={"x": 0, "y": 0, "orientation": "h", "yanchor": "top", "font": {"size": 11}},
    )
    return figure


def band(path_mm: FloatArray, covariance: FloatArray) -> tuple[FloatArray, IntArray]:
    """Surface of a tube about a path: outlines, seen along it, of what holds each point with 95 %.

    Parameters
    ----------
    path_mm : ndarray, shape (n, 3)
    covariance : ndarray, shape (n, 3, 3)
        Of the points' places, mm2.

    Returns
    -------
    (ndarray, shape (n * sides, 3), ndarray of int, shape (m, 3))
        Vertices and triangles.
    """
    along = np.gradient(path_mm, axis=0) if len(path_mm) > 1 else np.tile([0.0, 0.0, 1.0], (1, 1))
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    helper = np.where(np.abs(along[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    one = np.cross(along, helper)
    one /= np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-9)
    across = np.stack([one, np.cross(along, one)], axis=1)
    flat = across @ covariance @ across.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(flat)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :] @ vectors.transpose(0, 2, 1)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    circle = RADIUS_95 * np.stack([np.cos(angle), np.sin(angle)])
    rings = path_mm[:, None] + np.einsum("nab,bs,nac->nsc", root, circle, across)
    first = (np.arange(len(path_mm) - 1)[:, None] * _SIDES + np.arange(_SIDES)).ravel()
    beside = first - first % _SIDES + (first + 1) % _SIDES
    corners = np.stack([first, beside, first + _SIDES, beside + _SIDES])
    return rings.reshape(-1, 3), np.concatenate([corners[[0, 1, 2]].T, corners[[1, 3, 2]].T])


def ellipsoid(centre_mm: FloatArray, covariance: FloatArray) -> tuple[FloatArray, IntArray]:
    """Surface of what holds a point with 95 %: vertices and triangles."""
    values, vectors = np.linalg.eigh(covariance)
    polar = np.linspace(0.0, np.pi, _SIDES)
    around = 2 * np.pi * np.arange(_SIDES) / _SIDES
    unit = np.stack(
        [np.outer(np.sin(polar), np.cos(around)), np.outer(np.sin(polar), np.sin(around)),
         np.outer(np.cos(polar), np.ones(_SIDES))], axis=-1
    ).reshape(-1, 3)  # fmt: skip
    vertices = centre_mm + RADIUS_95 * unit * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    first = (np.arange(_SIDES - 1)[:, None] * _SIDES + np.arange(_SIDES)).ravel()
    beside = first - first % _SIDES + (first + 1) % _SIDES
    corners = np.stack([first, beside, first + _SIDES, beside + _SIDES])
    return vertices, np.concatenate([corners[[0, 1, 2]].T, corners[[1, 3, 2]].T])


def _traces(material: Material, mode: str, has_frames: bool, frame: int) -> list[Any]:
    poses = material.opened(mode).poses[mode]
    there: RigidTransform = poses[0].inv() * poses
    path = there.apply(material.grid.centre_mm)
    colour = colour_of(mode, material.modes)
    group: dict[str, Any] = {"legendgroup": mode, "hoverinfo": "skip"}
    traces = [
        _line(path, name=label_of(mode), line={"color": colour, "width": 5}, legendgroup=mode,
              hovertemplate="x %{x:.2f}, along %{y:.2f}, depth %{z:.2f} mm")
    ]  # fmt: skip
    errors = material.errors(mode)
    if errors is not None:
        some = np.unique(np.linspace(0, len(path) - 1, min(len(path), _RINGS)).round().astype(int))
        covariance = errors[:, :3, :3]
        shapes = [band(path[some], covariance[some])] if len(some) > 1 else []
        shapes.append(ellipsoid(path[-1], covariance[-1]))
        traces += [_surface(*each, colour, group) for each in shapes]
    if has_frames:
        every = frame_outlines(material.grid, there)
        some = np.unique(np.linspace(0, len(every) - 1, min(len(every), _OUTLINES)).round().astype(int))
        gap = np.full((1, 3), np.nan)
        lines = np.concatenate([part for k in some for part in (every[k], gap)])
        traces.append(_line(lines, line={"color": colour, "width": 1}, showlegend=False, **group))
        traces.append(_line(every[frame], line={"color": colour, "width": 6}, showlegend=False, **group))
    return traces


def _line(points: FloatArray, **look: Any) -> Any:
    x, y, z = points[:, _AXES].T
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", **look)


def _surface(vertices: FloatArray, triangles: IntArray, colour: str, group: dict[str, Any]) -> Any:
    x, y, z = vertices[:, _AXES].T
    i, j, k = triangles.T
    red, green, blue = hex_to_rgb(colour)
    return go.Mesh3d(
        x=x, y=y, z=z, i=i, j=j, k=k, color=f"rgb({red},{green},{blue})", opacity=0.22, **group
    )  # fmt: skip
