"""The plots of a phantom's recording: one frame, and a bar for every frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from bokeh.events import DoubleTap, SelectionGeometry, Tap
from bokeh.models import ColumnDataSource, HoverTool, Range1d
from bokeh.plotting import figure

from calibration.points import Recording
from calibration.solution import Solution

USED, DROPPED, REGION, LEFT_OUT, UNKNOWN = "#0072B2", "#D55E00", "#F0E442", "#999999", "#e8e8e8"
"""Colours of Okabe and Ito's palette, distinguishable with any colour vision."""
FOUND = "#56B4E9"
"""A lighter blue, seen on dark images."""
WIDTH_PX, HEIGHT_PX = 590, 440
_GLANCES = 7
_LOWEST, _HIGHEST = 1.0, 99.9
"""Percentiles of grey levels that are drawn black and white."""


class FramePlot:
    """One frame at a time, in pixels, with the shape that it has in millimetres, and a region drawn in it.

    Parameters
    ----------
    recording : Recording
    drawn : callable
        Called with the corners, shape (n, 2), of a box that was drawn.

    Attributes
    ----------
    plot : figure
        Columns to the right and rows down, from 0 at the centre of the first pixel.
    """

    def __init__(self, recording: Recording, drawn: Callable[[npt.NDArray[Any]], None]) -> None:
        _, columns, rows = recording.images.shape
        column_mm, row_mm = (float(size) for size in recording.pixel_mm)
        scale = min(WIDTH_PX / (columns * column_mm), HEIGHT_PX / (rows * row_mm))
        self._images, self._drawn = recording.images, drawn
        black, white = levels(recording)
        self.plot = figure(
            name="picture",
            frame_width=round(columns * column_mm * scale),
            frame_height=round(rows * row_mm * scale),
            x_range=Range1d(start=-0.5, end=columns - 0.5),
            y_range=Range1d(start=rows - 0.5, end=-0.5),
            x_axis_label=f"column ({column_mm:.3g} mm apart)",
            y_axis_label=f"row ({row_mm:.3g} mm apart)",
            tools="box_select,pan,wheel_zoom,reset",
            active_drag="box_select",
            toolbar_location="above",
        )
        self.plot.toolbar.logo = None
        self.plot.grid.visible = False
        self._image = ColumnDataSource({"image": []})
        self.plot.image(
            "image", x=-0.5, y=-0.5, dw=columns, dh=rows, source=self._image, palette="Greys256"
        ).glyph.color_mapper.update(low=black, high=white)
        self._region = ColumnDataSource({"x": [], "y": []})
        self.plot.patch("x", "y", source=self._region, fill_alpha=0.06, color=REGION, line_dash="dashed")
        self.plot.on_event(SelectionGeometry, self._selected)

    def show(self, frame: int, region: npt.ArrayLike | None) -> npt.NDArray[Any]:
        """Draw a frame and the region, and return the frame as it is, shape (column, row)."""
        image = self._images[frame]
        self._image.data = {"image": [np.ascontiguousarray(image.T)]}
        x, y = np.reshape([] if region is None else np.asarray(region), (-1, 2)).T
        self._region.data = {"x": x, "y": y}
        return image

    def _selected(self, event: SelectionGeometry) -> None:
        box: Any = event.geometry
        if event.final:
            (left, right), (top, bottom) = (sorted((box[f"{axis}0"], box[f"{axis}1"])) for axis in "xy")
            self._drawn(np.array([(left, top), (right, top), (right, bottom), (left, bottom)]))


class FrameStrip:
    """A bar for each frame: click to look at it, double click to leave it out or take it in again.

    Parameters
    ----------
    count : int
        Frames.
    chosen, toggled : callable
        Called with the number of a frame that was clicked, or double clicked.
    """

    def __init__(self, count: int, chosen: Callable[[int], None], toggled: Callable[[int], None]) -> None:
        self._count = count
        self._frames = ColumnDataSource({"frame": [], "colour": [], "told": []})
        self._residuals = ColumnDataSource({"frame": [], "residual": []})
        self._cursor = ColumnDataSource({"frame": [0]})
        self.plot = figure(
            name="strip",
            frame_width=WIDTH_PX,
            frame_height=70,
            x_range=Range1d(start=-0.5, end=count - 0.5),
            y_range=Range1d(start=0.0, end=1.0),
            x_axis_label="frame (click: look; double click: leave out)",
            tools="",
            toolbar_location=None,
        )
        self.plot.grid.visible = self.plot.yaxis.visible = False
        self.plot.yaxis.ticker.desired_num_ticks = 3
        bars = self.plot.vbar(
            "frame", width=0.9, bottom=0, top=1e6, color="colour", alpha=0.55, source=self._frames
        )
        self.plot.scatter("frame", "residual", size=4, color="black", source=self._residuals)
        self.plot.vspan("frame", source=self._cursor, color="black", line_width=2)
        self.plot.add_tools(HoverTool(renderers=[bars], tooltips=[("frame", "@frame"), ("", "@told")]))
        self.plot.on_event(Tap, lambda event: chosen(self._at(event.x)))
        self.plot.on_event(DoubleTap, lambda event: toggled(self._at(event.x)))

    def _at(self, place: float) -> int:
        return int(np.clip(round(place), 0, self._count - 1))

    def show(
        self, frame: int, used: Mapping[int, str], dropped: Mapping[int, str], left_out: Mapping[int, str]
    ) -> None:
        """Mark the frame that is looked at, and colour all by what became of them and why."""
        self._cursor.data = {"frame": [frame]}
        said = {
            at: (colour, why)
            for colour, frames in ((USED, used), (DROPPED, dropped), (LEFT_OUT, left_out))
            for at, why in frames.items()
        }
        colour, told = zip(
            *(said.get(at, (UNKNOWN, "not looked at")) for at in range(self._count)), strict=True
        )
        self._frames.data = {"frame": np.arange(self._count), "colour": colour, "told": told}

    def measure(self, solution: Solution | None) -> None:
        """Draw the largest residual of every frame over its bar."""
        self.plot.yaxis.visible = solution is not None
        if solution is None:
            self._residuals.data = {"frame": [], "residual": []}
            return
        points, worst = solution.points, np.abs(solution.residuals).max(axis=1)
        values = np.array([worst[points.frame == frame].max() for frame in points.frames])
        values = np.rad2deg(values) if solution.angular else values
        used = np.isin(points.frames, solution.points_used.frames)
        self._residuals.data = {"frame": points.frames, "residual": values}
        self.plot.y_range.update(start=0.0, end=float(1.3 * values[used].max() + 1e-9))
        self.plot.yaxis.axis_label = f"residual / {'°' if solution.angular else 'mm'}"


def levels(recording: Recording) -> tuple[float, float]:
    """Grey levels drawn black and white: those of 8 bits, or what most pixels of a few frames lie between."""
    images = recording.images
    if images.dtype == np.uint8:
        return 0.0, 255.0
    chosen = np.unique(np.linspace(0, images.shape[0] - 1, _GLANCES).astype(int))
    held = np.concatenate([np.asarray(images[int(i)], np.float32).ravel()[::11] for i in chosen])
    low, high = np.nanpercentile(held, (_LOWEST, _HIGHEST))
    return float(low), float(max(high, low + 1e-6))
