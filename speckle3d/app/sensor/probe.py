"""A probe drawn as it is held: its body, its image and the world's axes."""

from __future__ import annotations

import numpy as np
from plotly import graph_objects as go
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray

_BOX = np.array([(x, y, z) for x in (-1, 1) for y in (0, 1) for z in (-1, 1)], dtype=float)
_PARTS = {
    "#5c7082": [0, -1.45, 0] + _BOX * [0.2, 1.1, 0.16],
    "#34424e": [0, -0.4, 0] + _BOX * [0.44, 0.4, 0.14],
    "#f2be3c": [0, 0.0, 0] + _BOX * [0.44, 0.95, 0.005],
    "#b3261e": [-0.42, 0.0, 0] + _BOX * [0.02, 0.95, 0.01],
}
"""Colour and corners of the handle, the head, the image and its first vector, in the image's axes."""
_AXES = {"north": (1.6, 0.0, 0.0), "west": (0.0, 1.6, 0.0), "up": (0.0, 0.0, 1.6)}


def figure_probe() -> go.Figure:
    """Draw the world's axes and a probe, which `turn_probe` turns."""
    figure = go.Figure()
    for colour in _PARTS:
        figure.add_mesh3d(color=colour, alphahull=0, hoverinfo="skip", flatshading=True)
    for name, end in _AXES.items():
        x, y, z = np.array([(0.0, 0.0, 0.0), end]).T
        figure.add_scatter3d(
            x=x, y=y, z=z, mode="lines+text", text=["", name], line={"color": "#6b7780", "width": 3}
        )
    axis = {"visible": False, "range": [-1.7, 1.7]}
    eye = {"x": -1.2, "y": 0.9, "z": 0.7}
    return figure.update_layout(
        scene={"xaxis": axis, "yaxis": axis, "zaxis": axis, "aspectmode": "cube", "camera": {"eye": eye}},
        showlegend=False,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        uirevision="kept",
        template="none",
    )


def turn_probe(figure: go.Figure, world_from_image: Rotation) -> None:
    """Show the probe as it is held."""
    for trace, corners in zip(figure.data, _PARTS.values(), strict=False):
        turned: FloatArray = world_from_image.apply(corners)
        trace.update(dict(zip("xyz", turned.T, strict=True)))
