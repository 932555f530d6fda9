"""Plots of a sensor over time, one below the other on one axis."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from bokeh.events import RangesUpdate, Tap
from bokeh.models import ColumnDataSource, HoverTool, Range1d, Span
from bokeh.plotting import figure

from speckle3d.app.sensor.readings import Trace, thinned
from speckle3d.core.arrays import FloatArray

COLOURS = {"x": "#b3261e", "y": "#2e7d32", "z": "#20507a"}
DARK, BAND, DOUBT, LOSS = "#1c2730", "#20507a", "#e8a33d", "#b3261e"
_TOOLS = "xpan,xwheel_zoom,xbox_zoom,reset"


class TimePlots:
    """Plots that share the axis of time, with a cursor, for one viewer.

    Parameters
    ----------
    until_s : float
        End of the axis.
    """

    def __init__(self, until_s: float) -> None:
        self.range = Range1d(0.0, max(until_s, 1e-3), bounds="auto", min_interval=1e-3)
        self.figures: list[figure] = []
        self._cursors: list[Span] = []
        self._lines: list[tuple[ColumnDataSource, Trace]] = []
        self._taps: list[Callable[[float], None]] = []

    def add(self, label: str, traces: Sequence[Trace], height: int, legend: bool = False) -> figure:
        """Add a plot of some lines below the others."""
        plot = figure(
            height=height, sizing_mode="stretch_width", x_range=self.range, tools=_TOOLS, y_axis_label=label,
            active_drag="xpan", active_scroll="xwheel_zoom", min_border_left=64, min_border_right=8,
            toolbar_location=None if self.figures else "right", min_border_top=4, min_border_bottom=2,
        )  # fmt: skip
        plot.toolbar.logo = None
        for trace in traces:
            source = ColumnDataSource({"t": [], "y": []})
            named = {"legend_label": trace.name} if legend else {}
            line = plot.line("t", "y", source=source, color=COLOURS.get(trace.name, DARK), **named)
            about = [("time", "@t{0.000} s"), (trace.name, "@y{0.000}")]
            plot.add_tools(HoverTool(renderers=[line], tooltips=about, mode="mouse"))
            self._lines.append((source, trace))
        if legend:
            plot.legend.orientation = "horizontal"
            plot.legend.location = "top_left"
            plot.legend.padding, plot.legend.margin, plot.legend.spacing = 2, 2, 8
            plot.legend.label_text_font_size = "11px"
        cursor = Span(location=0.0, dimension="height", line_color=DARK, line_dash="dotted")
        plot.add_layout(cursor)
        plot.yaxis.axis_label_text_font_style = "normal"
        plot.on_event(Tap, self._tapped)
        plot.on_event(RangesUpdate, self._looked)
        self._cursors.append(cursor)
        self.figures.append(plot)
        self._show(self.range.start, self.range.end)
        return plot

    def band(self, plot: figure, trace: Trace, half: FloatArray, colour: str = BAND) -> None:
        """Add a band about a line, thinned once."""
        lower, upper = (Trace("", trace.time_s, trace.values + sign * half) for sign in (-1.0, 1.0))
        time_s, low = thinned(lower, -np.inf, np.inf)
        high = np.interp(time_s, upper.time_s, upper.values)
        plot.varea(x=time_s, y1=low, y2=high, fill_color=colour, fill_alpha=0.25, level="underlay")

    def shade(self, stretches: Sequence[tuple[float, float]], colour: str, plots: Sequence[figure]) -> None:
        """Shade stretches of time."""
        if stretches:
            begin, end = map(list, zip(*stretches, strict=True))
            for plot in plots:
                plot.vstrip(
                    x0=begin, x1=end, fill_color=colour, fill_alpha=0.3, line_color=None, level="underlay"
                )

    def mark(self, times_s: Sequence[float], colour: str) -> None:
        """Draw a line through all plots at some times."""
        for plot in self.figures if len(times_s) else ():
            plot.vspan(x=list(times_s), line_color=colour, line_alpha=0.8, line_width=1.5)

    def point_at(self, time_s: float) -> None:
        """Put the cursor at a time."""
        for cursor in self._cursors:
            cursor.location = time_s

    def on_tap(self, told: Callable[[float], None]) -> None:
        """Call with the time where a plot is clicked."""
        self._taps.append(told)

    def finish(self) -> list[figure]:
        """Name the axis of time below the last plot, and return all."""
        for plot in self.figures[:-1]:
            plot.xaxis.visible = False
        self.figures[-1].xaxis.axis_label = "time, s"
        self.figures[-1].xaxis.axis_label_text_font_style = "normal"
        self.figures[-1].height += 38
        return self.figures

    def _tapped(self, event: Tap) -> None:
        for told in self._taps:
            told(float(event.x))

    def _looked(self, event: RangesUpdate) -> None:
        self._show(event.x0, event.x1)

    def _show(self, from_s: float, until_s: float) -> None:
        for source, trace in self._lines:
            time_s, values = thinned(trace, from_s, until_s)
            source.data = {"t": time_s, "y": values}
