"""The image with its patches, axes in millimetres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from bokeh.models import ColumnDataSource, CustomJS, HoverTool, LinearColorMapper, Range1d
from bokeh.models.annotations import ColorBar
from bokeh.palettes import Viridis256
from bokeh.plotting import figure

from speckle3d.app.sweep.pairs import PatchValues
from speckle3d.core.arrays import ByteArray, FloatArray

HEIGHT_PX, WIDEST_PX = 350, 560
"""Of the picture itself, so that a page fits on a screen of 1366 x 768."""

COLOURINGS = {"distance": "distance (mm)", "sigma": "sigma of distance (mm)", "correlation": "correlation"}
"""What patches can be coloured by, and how the scale is labelled."""

_REJECTED = "#ff4d4d"
_GREYS = [f"#{k:02x}{k:02x}{k:02x}" for k in range(256)]


@dataclass(frozen=True)
class PatchCount:
    """Patches by what became of them."""

    used: int
    rejected: int
    without: int


class Picture:
    """One viewer's image of the current frame.

    Parameters
    ----------
    extent_mm : tuple of float
        Left, top, width, height.
    patch_mm : tuple of (float, float)
        Width and height of a patch.
    """

    def __init__(self, extent_mm: tuple[float, float, float, float], patch_mm: tuple[float, float]) -> None:
        left, top, width, height = extent_mm
        scale = min(HEIGHT_PX / height, WIDEST_PX / width)
        self._patch_mm = patch_mm
        nothing = np.zeros((2, 2), dtype=np.uint8)
        self.image = ColumnDataSource({"image": [nothing], "count": [0]}, name="sweep image")
        self.drawn = ColumnDataSource({"count": [0]})
        """Which image the browser has drawn last."""
        # What is sent faster than it is drawn would pile up.
        self.image.js_on_change(
            "data",
            CustomJS(args={"drawn": self.drawn}, code="drawn.data = {count: Array.from(cb_obj.data.count)}"),
        )
        self._patches = ColumnDataSource(_no_patches())
        self._crosses = ColumnDataSource({name: [] for name in ("x0", "y0", "x1", "y1")})
        self._colours = LinearColorMapper(palette=Viridis256, low=0.0, high=1.0, nan_color="rgba(0,0,0,0)")
        self.plot = figure(
            frame_width=max(round(width * scale), 90), frame_height=round(height * scale),
            x_range=Range1d(start=left, end=left + width), y_range=Range1d(start=top + height, end=top),
            x_axis_label="lateral (mm)", y_axis_label="depth (mm)",
            tools="pan,wheel_zoom,box_zoom,reset,save", active_scroll="wheel_zoom", match_aspect=True,
            background_fill_color="#000000", margin=0,
        )  # fmt: skip
        self.plot.toolbar.logo = None
        self.plot.grid.visible = False
        self.plot.image(
            "image", x=left, y=top, dw=width, dh=height, source=self.image,
            color_mapper=LinearColorMapper(palette=_GREYS, low=0, high=255),
        )  # fmt: skip
        drawn = self.plot.rect(
            "x", "y", width=patch_mm[0], height=patch_mm[1], angle="angle", source=self._patches,
            fill_color={"field": "value", "transform": self._colours}, fill_alpha="alpha",
            line_color="line", line_width=1,
        )  # fmt: skip
        # Hatching would make a canvas for every patch of every frame.
        self.plot.segment("x0", "y0", "x1", "y1", source=self._crosses, line_color=_REJECTED, line_width=1.2)
        told = [
            ("patch", "@state"), ("distance", "@distance{0.000} ± @sigma{0.000} mm"),
            ("correlation", "@correlation{0.000}"), ("at", "@x{0.0}, @y{0.0} mm"),
        ]  # fmt: skip
        self.plot.add_tools(HoverTool(renderers=[drawn], tooltips=told))
        self._bar = ColorBar(color_mapper=self._colours, width=10, padding=4, title="", visible=False)
        self.plot.add_layout(self._bar, "right")

    def show(self, image: ByteArray, count: int) -> None:
        """Draw an image, numbered so that `drawn` can tell it."""
        self.image.data = {"image": [image], "count": [count]}

    def clear(self) -> None:
        """Draw no patches."""
        self._bar.visible = False
        self._patches.data = _no_patches()
        self._cross(np.empty((0, 2)))

    def colour(self, patches: PatchValues, by: str, most: float, opacity: float) -> PatchCount:
        """Draw patches coloured by a quantity from zero to `most`."""
        self._bar.visible = True
        values = {
            "distance": patches.distance_mm,
            "sigma": patches.sigma_mm,
            "correlation": patches.correlation,
        }
        state = _states(patches)
        self._colours.high, self._bar.title = most, COLOURINGS[by]
        known = np.isfinite(values[by])
        self._cross(patches.centre_mm[[each == "rejected" for each in state]])
        self._patches.data = {
            "x": patches.centre_mm[:, 0],
            "y": patches.centre_mm[:, 1],
            "angle": np.full(len(state), patches.turn_rad),
            "value": values[by],
            "alpha": np.where(known, opacity, 0.0),
            "line": [_REJECTED if each == "rejected" else "#ffffff" for each in state],
            "state": state,
            "distance": patches.distance_mm,
            "sigma": patches.sigma_mm,
            "correlation": patches.correlation,
        }
        return PatchCount(*(state.count(name) for name in ("used", "rejected", "without distance")))

    def _cross(self, centre_mm: FloatArray) -> None:
        """Cross patches out."""
        half = 0.5 * np.array([self._patch_mm, (self._patch_mm[0], -self._patch_mm[1])])
        begin, end = (np.concatenate([centre_mm + sign * each for each in half]) for sign in (-1, 1))
        self._crosses.data = {"x0": begin[:, 0], "y0": begin[:, 1], "x1": end[:, 0], "y1": end[:, 1]}


def _states(patches: PatchValues) -> list[str]:
    """What became of each patch, in words."""
    if patches.used is None:
        return ["correlated"] * len(patches.centre_mm)
    measured = np.isfinite(patches.distance_mm)
    return [
        "used" if used else "rejected" if known else "without distance"
        for used, known in zip(patches.used.tolist(), measured.tolist(), strict=True)
    ]


def _no_patches() -> dict[str, list[object]]:
    names = (
        "x",
        "y",
        "angle",
        "value",
        "alpha",
        "line",
        "state",
        "distance",
        "sigma",
        "correlation",
    )
    return {name: [] for name in names}
