"""An orientation sensor, live or of a log: how it is held, what it reads, and whether to trust its field."""

from html import escape
from typing import Any

import numpy as np
import panel as pn
import param
from bokeh.models import ColumnDataSource, Range1d
from bokeh.models.annotations import Span
from bokeh.plotting import figure
from panel.viewable import Viewable
from plotly import graph_objects as go
from scipy.spatial.transform import Rotation

from speckle3d.app.look import Page, batch_changes
from speckle3d.app.plots import time_plot
from speckle3d.app.sensor.log import Columns, LogReadings
from speckle3d.app.sensor.watch import SHOWN_S, SensorWatch
from xsens.fusion.field import Trust

_BOX = np.array([(x, y, z) for x in (-1, 1) for y in (0, 1) for z in (-1, 1)], dtype=float)
_PARTS = {
    "#5c7082": [0, -1.45, 0] + _BOX * [0.2, 1.1, 0.16],
    "#34424e": [0, -0.4, 0] + _BOX * [0.44, 0.4, 0.14],
    "#f2be3c": [0, 0.0, 0] + _BOX * [0.44, 0.95, 0.005],
    "#b3261e": [-0.42, 0.0, 0] + _BOX * [0.02, 0.95, 0.01],
}
"""Colour and corners of the handle, the head, the image and its first vector, in the image's axes."""
_AXES = {"north": (1.6, 0.0, 0.0), "west": (0.0, 1.6, 0.0), "up": (0.0, 0.0, 1.6)}
_COLOURS = {Trust.YES: "#2e7d32", Trust.CARE: "#c77700", Trust.NO: "#b3261e", Trust.UNKNOWN: "#6b7780"}
_LINES = {"x": "#b3261e", "y": "#2e7d32", "z": "#20507a"}
_PLOTS = {
    "rate, °/s": ("x", "y", "z"),
    "field, sensor's unit": ("field",),
    "dip, °": ("dip",),
    "heading, °": ("heading",),
}
Source = LogReadings | SensorWatch
_REFRESH_MS, _STEP_S = 500, 0.1
"""Panel polls for messages that a browser has not taken: at 125 ms a loaded machine with pictures drawn in
software showed nothing new for five minutes."""
_LEFT_PX = 350
_KEY = (
    '<span style="color:#6b7780">rate: <span style="color:#b3261e">&mdash; x</span> '
    '<span style="color:#2e7d32">&mdash; y</span> <span style="color:#20507a">&mdash; z</span> &emsp;'
    '<span style="color:#e8a33d">&#9632;</span> the field is not believed &emsp;'
    '<span style="color:#b3261e">|</span> samples are missing &emsp;'
    '<span style="background:#20507a40">&emsp;</span> 95 % interval</span>'
)


def sensor_page(source: Source, sensor_from_image: Rotation | None = None) -> Page:
    """Page of an orientation sensor: readings, orientation, and trust in its field.

    Parameters
    ----------
    source : LogReadings or SensorWatch
        Of a log, or of a sensor at work.
    sensor_from_image : Rotation, optional
        How the sensor sits on the probe.

    Examples
    --------
    In a notebook:

    >>> import numpy as np
    >>> from speckle3d.app.sensor.log import LogReadings
    >>> from speckle3d.app.sensor.page import sensor_page
    >>> from xsens import ImuLog
    >>> log = ImuLog(np.arange(300) / 100.0, gyroscope_rad_s=np.zeros((300, 3)))
    >>> view = sensor_page(LogReadings(log)).view()
    """
    return Page("Sensor", lambda: _Viewer(source, sensor_from_image).layout())


class _Viewer(param.Parameterized):  # type: ignore[misc]
    """View of a sensor for one viewer."""

    step = param.Integer(0, label="step of 0.1 s")

    def __init__(self, source: Source, mounting: Rotation | None) -> None:
        super().__init__()
        self._source, self._mounting = source, mounting
        self._data = ColumnDataSource(self._columns())
        end_s = 0.0 if source.is_live else max(float(self._data.data["t"][-1]), 1e-3)
        self.param.step.bounds = (0, max(int(end_s / _STEP_S), 1))
        self._range = Range1d(-SHOWN_S if source.is_live else 0.0, end_s)
        self._cursor = Span(location=0.0, dimension="height", line_dash="dotted")
        self._probe = pn.pane.Plotly(figure_probe(), width=_LEFT_PX, height=330, margin=0)
        self._facts = pn.pane.HTML("", width=_LEFT_PX - 10)
        self._banner = pn.pane.HTML("", margin=(8, 10), sizing_mode="stretch_width")
        self.param.watch(self._show, "step")
        self._show()

    def layout(self) -> Viewable:
        """The sentence on the magnetometer above, the probe on the left, readings over time on the right."""
        lines = {
            label: names
            for label, names in _PLOTS.items()
            if self._source.is_live or np.isfinite(self._data.data[names[0]]).any()
        }
        plots = [self._plot(label, names) for label, names in (lines or _PLOTS).items()]
        plots[-1].xaxis.axis_label = "time before now, s" if self._source.is_live else "time, s"
        left: list[Any] = [self._probe, self._facts]
        if self._source.is_live:
            pn.state.add_periodic_callback(self._refresh, period=_REFRESH_MS)
        else:
            player = pn.widgets.Player.from_param(
                self.param.step,
                interval=round(1000 * _STEP_S),
                show_loop_controls=False,
                show_value=True,
                width=_LEFT_PX - 20,
            )
            left.insert(1, player)
        right = pn.Column(
            *(pn.pane.Bokeh(plot, sizing_mode="stretch_both", margin=0) for plot in plots),
            pn.pane.HTML(_KEY, margin=(4, 10)),
            sizing_mode="stretch_both",
        )
        row = pn.Row(
            pn.Column(*left, width=_LEFT_PX + 10, scroll="y-auto"), right, sizing_mode="stretch_both"
        )
        return pn.Column(self._banner, row, sizing_mode="stretch_both")

    def _columns(self) -> Columns:
        columns = self._source.columns()
        heading, half = columns["heading"], columns["half"]
        return columns | {"low": heading - half, "high": heading + half}

    def _plot(self, label: str, names: tuple[str, ...]) -> figure:
        plot = time_plot(label, self._range, self._cursor, self._go, min_border_left=64)
        for name in names:
            plot.line("t", name, source=self._data, color=_LINES.get(name, "#1c2730"))
        if names == ("field",):
            plot.scatter("t", "doubt", source=self._data, color="#e8a33d", size=6, marker="square")
        if names == ("heading",):
            plot.varea("t", "low", "high", source=self._data, fill_color="#20507a", fill_alpha=0.25)
        if gaps := self._source.gaps_s():
            plot.vspan(x=gaps, line_color="#b3261e", line_width=1.5)
        return plot

    def _go(self, time_s: float) -> None:
        low, high = self.param.step.bounds
        self.step = int(np.clip(round(time_s / _STEP_S), low, high))

    @batch_changes
    def _refresh(self) -> None:
        self._data.data = self._columns()
        self._show()

    @batch_changes
    def _show(self, *_: Any) -> None:
        """Show how it is held, and what is to say."""
        time_s = _STEP_S * self.step
        self._cursor.location = time_s
        rotation = self._source.orientation_at(time_s)
        if rotation is not None:
            world_from_image = rotation * (self._mounting or Rotation.identity())
            for trace, corners in zip(self._probe.object.data, _PARTS.values(), strict=False):
                trace.update(dict(zip("xyz", world_from_image.apply(corners).T, strict=True)))
            self._probe.param.trigger("object")
        rows = self._source.facts(time_s)
        if self._mounting is None:
            rows.append(("probe", "not calibrated: the sensor's axes drawn as the image's"))
        cell = '<tr><td style="color:#6b7780;vertical-align:top;white-space:nowrap">{}</td><td>{}</td></tr>'
        self._facts.object = f"<table>{''.join(cell.format(*map(escape, row)) for row in rows)}</table>"
        if self._source.is_live or not self._banner.object:
            self._banner.object = banner(*self._source.judgement())


def banner(trust: Trust, sentence: str) -> str:
    """HTML of the sentence on the magnetometer, coloured by what it says."""
    colour = _COLOURS[trust]
    style = f"border-left:5px solid {colour};background:{colour}18;padding:7px 12px;font-size:14px"
    return f'<div class="magnetometer" style="{style}">{escape(sentence)}</div>'


def figure_probe() -> go.Figure:
    """Draw the world's axes and a probe, not yet turned."""
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
