"""All frames of a recording in a row: which were used, and why others were not."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from bokeh.events import DoubleTap, Tap
from bokeh.models import BasicTicker, ColumnDataSource, HoverTool, Range1d
from bokeh.plotting import figure

from calibration.plane import Solution
from calibration.points import Seen
from calibration.recording import Outcome
from speckle3d.app.phantom.picture import DROPPED, USED
from speckle3d.calibrating.phantoms import BY_HAND

LEFT_OUT, UNKNOWN = "#999999", "#e8e8e8"


class FrameStrip:
    """A bar for each frame: click to look at it, double click to leave it out or take it in again.

    Parameters
    ----------
    count : int
        Frames.
    chosen, toggled : callable
        Called with the number of a frame that was clicked, or double clicked.
    """

    def __init__(
        self, count: int, width: int, chosen: Callable[[int], None], toggled: Callable[[int], None]
    ) -> None:
        self._count = count
        self._used: dict[int, str] = {}
        self._dropped: dict[int, str] = {}
        self._left_out: tuple[int, ...] = ()
        self._frames = ColumnDataSource(
            {"frame": np.arange(count), "colour": [UNKNOWN] * count, "told": ["not looked at"] * count}
        )
        self._residuals = ColumnDataSource({"frame": [], "residual": []})
        self.plot = figure(
            frame_width=width,
            frame_height=70,
            x_range=Range1d(start=-0.5, end=count - 0.5),
            y_range=Range1d(start=0.0, end=1.0),
            x_axis_label="frame (click: see it; double click: leave it out, take it in)   "
            "blue: used, orange: not used, grey: left out",
            tools="",
            toolbar_location=None,
            name="strip",
        )
        self.plot.xaxis.axis_label_text_font_size = "12px"
        self.plot.grid.visible = False
        # Without a calibration there are no residuals.
        self.plot.yaxis.visible = False
        self.plot.yaxis.ticker = BasicTicker(desired_num_ticks=3)
        bars = self.plot.vbar(
            "frame", width=0.9, bottom=0, top=1e6, color="colour", alpha=0.55, source=self._frames
        )
        self.plot.scatter("frame", "residual", size=4, color="black", source=self._residuals)
        self._cursor = ColumnDataSource({"frame": [0]})
        self.plot.vspan("frame", source=self._cursor, color="black", line_width=2)
        self.plot.add_tools(HoverTool(renderers=[bars], tooltips=[("frame", "@frame"), ("", "@told")]))
        self.plot.on_event(Tap, lambda event: chosen(self._at(event.x)))
        self.plot.on_event(DoubleTap, lambda event: toggled(self._at(event.x)))

    def _at(self, place: float) -> int:
        return int(np.clip(round(place), 0, self._count - 1))

    def point_at(self, frame: int) -> None:
        """Mark the frame that is looked at."""
        self._cursor.data = {"frame": [frame]}

    def leave_out(self, frames: tuple[int, ...]) -> None:
        """Say which frames are left out by hand."""
        self._left_out = frames
        self._draw()

    def picked(self, frames: Iterable[int]) -> None:
        """Say which frames have points; what became of them before is forgotten."""
        self._used, self._dropped = dict.fromkeys(frames, "has points"), {}
        self._draw()

    def tell(self, seen: Seen | None, outcome: Outcome | None) -> None:
        """Say of each frame what became of it, and draw its largest residual over its bar."""
        self._used, self._dropped = {}, {}
        if seen is not None:
            self._used = dict.fromkeys(map(int, seen.frame), "found")
            self._dropped = dict(seen.dropped)
        if outcome is not None:
            frames = outcome.calibration.frames
            self._used, self._dropped = dict.fromkeys(frames.used, "used"), dict(frames.dropped)
        self._draw()
        self._measure(None if outcome is None else outcome.solution)

    def _draw(self) -> None:
        colour, told = [UNKNOWN] * self._count, ["not looked at"] * self._count
        for frames, shade in ((self._used, USED), (self._dropped, DROPPED)):
            for frame, why in frames.items():
                colour[frame], told[frame] = shade, why
        for frame in self._left_out:
            colour[frame], told[frame] = LEFT_OUT, BY_HAND
        self._frames.data = {"frame": np.arange(self._count), "colour": colour, "told": told}

    def _measure(self, solution: Solution | None) -> None:
        self.plot.yaxis.visible = solution is not None
        if solution is None:
            self._residuals.data = {"frame": [], "residual": []}
            return
        worst = np.abs(solution.residuals).max(axis=1)
        frames = solution.points.frames
        largest = np.array([worst[solution.points.frame == frame].max() for frame in frames])
        values = np.rad2deg(largest) if solution.angular else largest
        used = np.isin(frames, solution.points_used.frames)
        self._residuals.data = {"frame": frames, "residual": values}
        self.plot.y_range.update(start=0.0, end=float(1.3 * values[used].max() + 1e-9))
        self.plot.yaxis.axis_label = f"residual / {'deg' if solution.angular else 'mm'}"
