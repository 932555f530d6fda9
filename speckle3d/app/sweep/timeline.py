"""The time line below the image: flags and doubts at their frames, sensors' streams, and where one is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Event, Tap
from bokeh.models import ColumnDataSource, FactorRange, HoverTool, Range1d
from bokeh.models.annotations import Span
from bokeh.plotting import figure
from panel.viewable import Viewable

from speckle3d.app.sweep.findings import NAMES
from speckle3d.app.sweep.streams import Stream
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.doubts import Doubt

COLOURS = ("#0072b2", "#d55e00", "#009e73")
"""Of three quantities, told apart by the colour-blind (Okabe and Ito)."""
CURSOR = "#cc0000"
FLAGGED, DOUBTED = "#d55e00", "#7b3fa0"
_ROW_PX, _STREAM_PX, _LEFT_PX = 15, 135, 108


class TimeLine:
    """Plots over the images' clock that share their range and a cursor; a click on any of them jumps there.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Of the frames.
    jump : callable
        Called with the frame that is clicked.
    """

    def __init__(self, time_s: FloatArray, jump: Callable[[int], None]) -> None:
        self._time_s, self._jump = time_s, jump
        pause = float(np.median(np.diff(time_s))) if time_s.size > 1 else 0.04
        self._half_s = pause / 2
        margin = max(0.01 * float(np.ptp(time_s)), pause)
        self._range = Range1d(
            start=float(time_s[0]) - margin, end=float(time_s[-1]) + margin, min_interval=4 * pause
        )
        self.cursor = Span(location=float(time_s[0]), dimension="height", line_color=CURSOR, line_width=1.5)
        self._marks = ColumnDataSource(_no_marks())
        self._rows = FactorRange(factors=["no frame"])
        self.marks = self._plot(_ROW_PX, y_range=self._rows)
        """Plot of what `mark` marks; not seen while that is nothing."""
        marks = self.marks.quad(
            left="left", right="right", bottom="bottom", top="top", color="colour", source=self._marks
        )
        self.marks.add_tools(
            HoverTool(renderers=[marks], tooltips="<div style='max-width:30em'>@words</div>")
        )
        self.marks.xaxis.visible = False
        self.marks.ygrid.visible = False

    def move(self, frame: int) -> None:
        """Put the cursor at a frame."""
        self.cursor.location = float(self._time_s[frame])

    def mark(self, flags: IntArray | None, doubts: Sequence[Doubt]) -> None:
        """Mark flagged frames, a row for every kind of flag there is, and stretches in doubt."""
        marks = _no_marks()
        rows = []
        for flag, name in NAMES.items():
            frames = [] if flags is None else np.flatnonzero(flags & int(flag)).tolist()
            if frames:
                rows.append(name)
            for frame in frames:
                self._add(marks, frame, frame, name, FLAGGED, name)
        for doubt in doubts:
            for first, last in doubt.frames:
                rows += [] if doubt.about in rows else [doubt.about]
                self._add(marks, first, last, doubt.about, DOUBTED, doubt.consequence)
        self._rows.factors = rows[::-1] or ["no frame"]
        self.marks.height, self.marks.visible = _ROW_PX * max(len(rows), 1) + 6, bool(rows)
        self._marks.data = marks

    def streams(self, sensors: dict[str, list[Stream]]) -> list[Viewable]:
        """A plot for each sensor, with a choice of what is shown of it."""
        return [self._stream(sensor, some) for sensor, some in sensors.items()]

    def _stream(self, sensor: str, some: Sequence[Stream]) -> Viewable:
        source = ColumnDataSource()
        plot = self._plot(_STREAM_PX)
        for part, colour in enumerate(COLOURS):
            plot.line(
                "time", f"part{part}", source=source, color=colour, line_width=1.4, legend_label=str(part)
            )
        legend: Any = plot.legend[0]
        plot.add_layout(legend, "right")
        legend.update(padding=2, spacing=0, margin=2, label_text_font_size="11px", border_line_alpha=0.0)
        names = {f"{each.name}": each for each in some}
        choice = pn.widgets.RadioButtonGroup(
            options=list(names), value=next(iter(names)), button_type="default", button_style="outline",
            margin=(0, 5),
        )  # fmt: skip

        def show(_: object = None) -> None:
            stream = names[choice.value]
            source.data = {"time": stream.time_s, **{f"part{k}": stream.values[:, k] for k in range(3)}}
            for item, part in zip(legend.items, stream.parts, strict=True):
                item.label = {"value": part}
            plot.yaxis.axis_label = stream.unit

        choice.param.watch(show, "value")
        show()
        plot.xaxis.axis_label = "time (s)"
        title = pn.pane.HTML(f"<b>{sensor}</b>", margin=(6, 5, 0, _LEFT_PX))
        return pn.Column(pn.Row(title, choice), pn.pane.Bokeh(plot, sizing_mode="stretch_width"), margin=0)

    def _plot(self, height: int, **more: Any) -> figure:
        plot = figure(
            height=height, sizing_mode="stretch_width", x_range=self._range, tools="xpan,xwheel_zoom",
            active_scroll="xwheel_zoom", toolbar_location=None, min_border_left=_LEFT_PX, min_border_top=3,
            min_border_bottom=3, **more,
        )  # fmt: skip
        plot.add_layout(self.cursor)
        plot.on_event(Tap, self._tapped)
        plot.outline_line_color = "#c9d1d9"
        plot.grid.grid_line_color = "#eef1f4"
        return plot

    def _tapped(self, event: Event) -> None:
        if isinstance(event, Tap) and event.x is not None:
            self._jump(int(np.argmin(np.abs(self._time_s - event.x))))

    def _add(
        self, marks: dict[str, list[object]], first: int, last: int, row: str, colour: str, words: str
    ) -> None:
        left, right = self._time_s[first] - self._half_s, self._time_s[last] + self._half_s
        values = (float(left), float(right), (row, -0.35), (row, 0.35), colour, words)
        for name, value in zip(marks, values, strict=True):
            marks[name].append(value)


def _no_marks() -> dict[str, list[object]]:
    return {"left": [], "right": [], "bottom": [], "top": [], "colour": [], "words": []}
