"""A live sensor: how it is held now, its last minute, and whether its magnetometer can be trusted here."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure
from panel.viewable import Viewable

from speckle3d.app.sensor.page import banner_html, table
from speckle3d.app.sensor.plots import BAND, COLOURS, DARK, DOUBT
from speckle3d.app.sensor.probe import AZIMUTH_DEG, ProbePicture
from speckle3d.app.sensor.watch import SHOWN_S, SensorWatch
from speckle3d.core.arrays import FloatArray
from xsens.fusion.field import Trust, field_now
from xsens.live.monitor import LiveState

_REFRESH_MS = 125
_LEFT_PX = 350
_NAN = float("nan")
_COLUMNS = ("t", "x", "y", "z", "field", "dip", "heading", "low", "high", "doubt")


class LiveSensorPage:
    """A sensor while it is recorded.

    Parameters
    ----------
    watch : SensorWatch
        Running.
    """

    title = "Sensor"

    def __init__(self, watch: SensorWatch) -> None:
        self._watch = watch

    def view(self) -> Viewable:
        """As the page of a log, of now and the last minute."""
        source = ColumnDataSource({name: [] for name in _COLUMNS})
        span = Range1d(-SHOWN_S, 0.0)
        plots = [
            _plot("rate, \N{DEGREE SIGN}/s", ("x", "y", "z"), source, span, 150),
            _plot("field, sensor's unit", ("field",), source, span, 115),
            _plot("dip, \N{DEGREE SIGN}", ("dip",), source, span, 115),
            _plot("heading, \N{DEGREE SIGN}", ("heading",), source, span, 165),
        ]
        plots[-1].varea("t", "low", "high", source=source, fill_color=BAND, fill_alpha=0.25, level="underlay")
        plots[-1].xaxis.axis_label = "time before now, s"
        for plot in plots[:-1]:
            plot.xaxis.visible = False
        picture = ProbePicture()
        side = pn.widgets.IntSlider(
            name="seen from, degrees from north to west", start=0, end=359, step=5, value=int(AZIMUTH_DEG),
            width=_LEFT_PX - 20,
        )  # fmt: skip
        side.param.watch(lambda event: picture.look_from(float(event.new)), "value")
        words = pn.pane.HTML("", width=_LEFT_PX - 10)
        sentence = pn.pane.HTML("", margin=(8, 10), sizing_mode="stretch_width")

        def show() -> None:
            states = self._watch.states()
            sentence.object = banner_html(*self._judged(states))
            if states:
                words.object = table(self._facts(states[-1]))
                source.data = columns(states)
                if states[-1].world_from_sensor is not None:
                    picture.turn(states[-1].world_from_sensor)

        show()
        pn.state.add_periodic_callback(show, period=_REFRESH_MS)
        left = pn.Column(pn.pane.Bokeh(picture.plot), side, words, width=_LEFT_PX, margin=0)
        right = pn.Column(
            *(pn.pane.Bokeh(each, sizing_mode="stretch_width", margin=0) for each in plots),
            pn.pane.HTML(_KEY, margin=(4, 10)),
            sizing_mode="stretch_width",
        )
        return pn.Column(
            sentence, pn.Row(left, right, sizing_mode="stretch_width"), sizing_mode="stretch_width"
        )

    def _judged(self, states: Sequence[LiveState]) -> tuple[Trust, str]:
        if self._watch.failure:
            return Trust.NO, f"The recording has ended: {self._watch.failure}"
        return judged(states)

    def _facts(self, now: LiveState) -> list[tuple[str, str]]:
        rows = [("sensor", f"on {self._watch.port}" if now.connected else f"NOT CONNECTED: {now.note}")]
        if now.world_from_sensor is not None:
            yaw, pitch, roll = now.world_from_sensor.as_euler("ZYX", degrees=True)
            degree = "\N{DEGREE SIGN}"
            rows.append(
                ("roll, pitch, yaw", f"{roll:+.1f}{degree}, {pitch:+.1f}{degree}, {yaw:+.1f}{degree}")
            )
        kept = "nowhere: named with --record they are kept" if self._watch.record is None else ""
        return [
            *rows,
            ("samples", f"{now.samples} in {now.elapsed_s:.0f} s, {now.rate_hz:.1f} per second"),
            ("lost", f"{now.lost} samples, {now.interruptions} interruptions"),
            ("world", "x magnetic north, y west, z up"),
            ("its bytes", kept or f"in {self._watch.record}"),
        ]


_KEY = (
    '<span style="color:#6b7780"><span style="color:#e8a33d">&#9632;</span> the field is not trusted &emsp;'
    '<span style="background:#20507a40">&emsp;</span> 95 % band</span>'
)


def judged(states: Sequence[LiveState]) -> tuple[Trust, str]:
    """Whether the magnetometer can be trusted, by the filter's last state and what it disbelieved lately."""
    if not states:
        return Trust.UNKNOWN, "Waiting for the sensor's first samples."
    now = states[-1]
    if not now.connected:
        return Trust.UNKNOWN, f"The sensor is not connected: {now.note or 'waiting for it'}."
    if now.fused is None:
        return Trust.UNKNOWN, "The magnetometer cannot be judged here: gyroscope or accelerometer is missing."
    if not np.isfinite(now.field):
        return Trust.UNKNOWN, "The magnetometer cannot be judged here: the sensor sends none."
    known = [each.fused.disturbed for each in states if each.fused is not None and each.fused.started]
    found = field_now(now.fused, float(np.mean(known)) if known else 0.0)
    if not now.fused.started:
        return Trust.UNKNOWN, "Hold the sensor still: its filter is finding up and north."
    return found.trust, found.sentence()


def columns(states: Sequence[LiveState]) -> dict[str, FloatArray]:
    """What the plots show of some states: time before the last, and readings as columns."""
    rows = [_row(state) for state in states]
    found = dict(zip(_COLUMNS, np.array(rows, dtype=float).T, strict=True))
    found["t"] = found["t"] - found["t"][-1]
    there = np.isfinite(found["heading"])
    found["heading"][there] = np.degrees(np.unwrap(np.radians(found["heading"][there])))
    half = 0.5 * (found["high"] - found["low"])
    found["low"], found["high"] = found["heading"] - half, found["heading"] + half
    return found


def _row(state: LiveState) -> tuple[float, ...]:
    rate = [_NAN] * 3 if state.rate_rad_s is None else np.degrees(state.rate_rad_s).tolist()
    heading = half = _NAN
    if state.world_from_sensor is not None:
        matrix = state.world_from_sensor.as_matrix()
        heading = float(np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0])))
    if state.fused is not None and state.fused.started:
        half = 1.96 * float(np.degrees(state.fused.standard_deviation_rad[2]))
    doubt = state.field if state.disturbed else _NAN
    dip = float(np.degrees(state.dip_rad))
    return (state.elapsed_s, *rate, state.field, dip, heading, heading - half, heading + half, doubt)


def _plot(label: str, names: Sequence[str], source: ColumnDataSource, span: Range1d, height: int) -> figure:
    plot = figure(
        height=height, sizing_mode="stretch_width", x_range=span, tools="", toolbar_location=None,
        y_axis_label=label, min_border_left=64, min_border_right=8, min_border_top=4, min_border_bottom=2,
    )  # fmt: skip
    plot.yaxis.axis_label_text_font_style = plot.xaxis.axis_label_text_font_style = "normal"
    for name in names:
        legend = {"legend_label": name} if len(names) > 1 else {}
        plot.line("t", name, source=source, color=COLOURS.get(name, DARK), **legend)
    if names == ("field",):
        plot.scatter("t", "doubt", source=source, color=DOUBT, size=6, marker="square")
    if len(names) > 1:
        plot.legend.orientation, plot.legend.location = "horizontal", "top_left"
        plot.legend.padding, plot.legend.margin, plot.legend.label_text_font_size = 2, 2, "11px"
    return plot
