"""The plots of a phantom's recording: one frame, and a bar for every frame."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from bokeh.events import DoubleTap, SelectionGeometry, Tap
from bokeh.models import ColumnDataSource, HoverTool, Range1d

from calibration.points import Recording
from speckle3d.app.plots import ImagePlot, empty_plot, greys
from speckle3d.core.arrays import AnyArray

BLUE, SKY_BLUE, ORANGE, YELLOW, GREY, PALE = "#0072B2", "#56B4E9", "#D55E00", "#F0E442", "#999999", "#e8e8e8"
"""Okabe and Ito's palette, distinguishable with any colour vision: blue for what is used, sky blue for that
on dark images, orange for what is not, grey for frames left out by hand."""
_GREYS = 1.0, 99.9
"""Percentiles of grey levels of other images than 8-bit ones that are drawn black and white."""


class FramePlot(ImagePlot):
    """One frame at a time, in pixels, with the shape that it has in millimetres, and a region drawn in it.

    Columns to the right and rows down, from 0 at the centre of the first pixel.

    Parameters
    ----------
    recording : Recording
    on_box : callable
        Called with the corners, shape (n, 2), of a box that was drawn.
    """

    def __init__(self, recording: Recording, on_box: Callable[[AnyArray], None]) -> None:
        column_mm, row_mm = (float(size) for size in recording.pixel_mm)
        super().__init__(
            f"column ({column_mm:.3g} mm apart)",
            f"row ({row_mm:.3g} mm apart)",
            "box_select",
            name="picture",
            aspect_scale=column_mm / row_mm,
            active_drag="box_select",
            toolbar_location="above",
        )
        self._images, self._on_box = recording.images, on_box
        middle = recording.images[recording.images.shape[0] // 2]
        self._levels = (0.0, 255.0) if middle.dtype == np.uint8 else np.nanpercentile(middle, _GREYS)
        self._region = ColumnDataSource({"x": [], "y": []})
        self.plot.patch("x", "y", source=self._region, fill_alpha=0.06, color=YELLOW, line_dash="dashed")
        self.plot.on_event(SelectionGeometry, self._select)

    def show_frame(self, frame: int, region: npt.ArrayLike | None) -> AnyArray:
        """Draw a frame and the region, and return the frame as it is, shape (column, row)."""
        image = self._images[frame]
        self.show(greys(image.T, *self._levels), (0.0, 0.0), (1.0, 1.0))
        x, y = np.reshape([] if region is None else np.asarray(region), (-1, 2)).T
        self._region.data = {"x": x, "y": y}
        return image

    def _select(self, event: SelectionGeometry) -> None:
        box: Any = event.geometry
        if event.final:
            (left, right), (top, bottom) = (sorted((box[f"{axis}0"], box[f"{axis}1"])) for axis in "xy")
            self._on_box(np.array([(left, top), (right, top), (right, bottom), (left, bottom)]))


class FrameStrip:
    """A bar for each frame: click to look at it, double click to leave it out or take it in again.

    Parameters
    ----------
    count : int
        Frames.
    on_tap, on_double_tap : callable
        Called with the number of a frame that was clicked, or double clicked.
    """

    def __init__(
        self, count: int, on_tap: Callable[[int], None], on_double_tap: Callable[[int], None]
    ) -> None:
        self._count = count
        self._frames = ColumnDataSource({"frame": [], "colour": [], "reason": []})
        self._cursor = ColumnDataSource({"frame": [0]})
        self.plot = empty_plot(
            "frame (click: look; double click: leave out)",
            "",
            name="strip",
            height=100,
            sizing_mode="stretch_width",
            x_range=Range1d(start=-0.5, end=count - 0.5),
            y_range=Range1d(start=0.0, end=1.0),
            tools="",
            toolbar_location=None,
        )
        self.plot.grid.visible = self.plot.yaxis.visible = False
        bars = self.plot.vbar(
            "frame", width=0.9, bottom=0, top=1, color="colour", alpha=0.55, source=self._frames
        )
        self.plot.vspan("frame", source=self._cursor, color="black", line_width=2)
        self.plot.add_tools(HoverTool(renderers=[bars], tooltips=[("frame", "@frame"), ("", "@reason")]))
        self.plot.on_event(Tap, lambda event: on_tap(self._at(event.x)))
        self.plot.on_event(DoubleTap, lambda event: on_double_tap(self._at(event.x)))

    def _at(self, place: float) -> int:
        return int(np.clip(round(place), 0, self._count - 1))

    def show(
        self, frame: int, uses: Mapping[int, str], refusals: Mapping[int, str], left_out: Mapping[int, str]
    ) -> None:
        """Mark the frame that is looked at, and colour all by what became of them and why."""
        self._cursor.data = {"frame": [frame]}
        colours, reasons = [PALE] * self._count, ["not looked at"] * self._count
        for colour, frames in ((ORANGE, refusals), (BLUE, uses), (GREY, left_out)):
            for at, reason in frames.items():
                colours[at], reasons[at] = colour, reason
        self._frames.data = {"frame": np.arange(self._count), "colour": colours, "reason": reasons}
