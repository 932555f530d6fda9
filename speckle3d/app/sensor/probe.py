"""A probe drawn as it is held: its body, its image and the world's axes, seen from one side."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray

AZIMUTH_DEG, ELEVATION_DEG = 215.0, 25.0
"""Where one looks from: behind a probe that points north, a little to its side and from above."""

_REACH = 1.75
_LIGHT = np.array([0.3, 0.4, 0.86])
_BODY, _HEAD, _IMAGE = (92, 112, 130), (52, 66, 78), (242, 190, 60)
_AXES = (
    ("north", (1.0, 0.0, 0.0), "#b3261e"),
    ("west", (0.0, 1.0, 0.0), "#2e7d32"),
    ("up", (0, 0, 1.0), "#20507a"),
)


def _ring(y: float, half_x: float, half_z: float) -> FloatArray:
    """Eight corners of a rounded section of the probe at a depth along its image."""
    cut = 0.45
    corners = [(1, cut), (cut, 1), (-cut, 1), (-1, cut), (-1, -cut), (-cut, -1), (cut, -1), (1, -cut)]
    return np.array([(half_x * x, y, half_z * z) for x, z in corners])


_RINGS = [
    _ring(-1.45, 0.20, 0.16), _ring(-0.55, 0.22, 0.18), _ring(-0.28, 0.42, 0.17), _ring(0.0, 0.44, 0.13),
]  # fmt: skip
"""From the cable to the transducer's face, in the image's axes: x lateral, y into the depth."""


def _faces() -> list[tuple[FloatArray, tuple[int, int, int]]]:
    faces = [(_RINGS[0], _BODY), (_RINGS[-1], _HEAD)]
    for k, (one, two) in enumerate(pairwise(_RINGS)):
        for i in range(8):
            j = (i + 1) % 8
            faces.append((np.array([one[i], one[j], two[j], two[i]]), _HEAD if k == 2 else _BODY))
    return faces


_FACES = _faces()
_PLANE = np.array([(-0.44, 0.02, 0.0), (0.44, 0.02, 0.0), (0.44, 0.95, 0.0), (-0.44, 0.95, 0.0)])
_FIRST_VECTOR = np.array([(-0.44, 0.02, 0.0), (-0.44, 0.95, 0.0), (-0.40, 0.95, 0.0), (-0.40, 0.02, 0.0)])


class ProbePicture:
    """A plot of the probe, for one viewer.

    Parameters
    ----------
    sensor_from_image : Rotation, optional
        How the sensor sits on the probe; without it its axes are taken for the image's.
    size : int
        Pixels of the plot's sides.
    """

    def __init__(self, sensor_from_image: Rotation | None = None, size: int = 340) -> None:
        self._mounting = sensor_from_image or Rotation.identity()
        self._azimuth_deg, self._world = AZIMUTH_DEG, Rotation.identity()
        self._patches = ColumnDataSource({name: [] for name in ("xs", "ys", "color", "alpha")})
        self._axes = ColumnDataSource({name: [] for name in ("x", "y", "x1", "y1", "color", "name")})
        reach = (-_REACH, _REACH)
        self.plot = figure(
            width=size, height=size, x_range=reach, y_range=reach, tools="", toolbar_location=None,
            match_aspect=True, outline_line_color=None, min_border=0,
        )  # fmt: skip
        self.plot.axis.visible = False
        self.plot.grid.visible = False
        self.plot.segment("x", "y", "x1", "y1", color="color", line_width=2, source=self._axes)
        self.plot.text(
            "x1", "y1", text="name", text_color="color", text_font_size="12px", text_baseline="middle",
            text_align="center", source=self._axes,
        )  # fmt: skip
        self.plot.patches(
            "xs", "ys", fill_color="color", line_color="color", fill_alpha="alpha", line_alpha="alpha",
            source=self._patches,
        )  # fmt: skip
        self._draw()

    def turn(self, world_from_sensor: Rotation) -> None:
        """Show the probe as its sensor is now."""
        self._world = world_from_sensor * self._mounting
        self._draw()

    def look_from(self, azimuth_deg: float) -> None:
        """Look from another direction, counted from north to west."""
        self._azimuth_deg = azimuth_deg
        self._draw()

    def _draw(self) -> None:
        view = _view(self._azimuth_deg)
        drawn = []
        for corners, colour in _FACES:
            seen = self._world.apply(corners)
            normal = np.cross(seen[1] - seen[0], seen[2] - seen[1])
            light = abs(float(normal @ _LIGHT)) / max(float(np.linalg.norm(normal)), 1e-9)
            shade = tuple(round(c * (0.6 + 0.5 * light)) for c in colour)
            drawn.append((seen @ view.T, shade, 1.0))
        drawn.append((self._world.apply(_PLANE) @ view.T, _IMAGE, 0.55))
        drawn.append((self._world.apply(_FIRST_VECTOR) @ view.T, (179, 38, 30), 0.9))
        drawn.sort(key=lambda each: float(each[0][:, 2].mean()))  # the farthest first
        self._patches.data = {
            "xs": [corners[:, 0].tolist() for corners, _, _ in drawn],
            "ys": [corners[:, 1].tolist() for corners, _, _ in drawn],
            "color": [f"#{min(r, 255):02x}{min(g, 255):02x}{min(b, 255):02x}" for _, (r, g, b), _ in drawn],
            "alpha": [alpha for _, _, alpha in drawn],
        }
        ends = 1.5 * np.array([axis for _, axis, _ in _AXES]) @ view.T
        columns: dict[str, Any] = {"x": [0.0] * 3, "y": [0.0] * 3, "x1": ends[:, 0], "y1": ends[:, 1]}
        self._axes.data = {**columns, "color": [c for _, _, c in _AXES], "name": [n for n, _, _ in _AXES]}


def _view(azimuth_deg: float) -> FloatArray:
    """Rows: right, up on the screen, and towards the eye, in the world."""
    azimuth, elevation = np.radians([azimuth_deg, ELEVATION_DEG])
    eye = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(eye, right), eye])
