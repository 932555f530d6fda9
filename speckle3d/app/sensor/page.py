"""The orientation sensor's log: how it was held, what it read, whether its magnetometer can be trusted."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from html import escape

import numpy as np
import panel as pn
from panel.viewable import Viewable
from scipy.spatial.transform import Rotation

from speckle3d.app.sensor.plots import DOUBT, LOSS, TimePlots
from speckle3d.app.sensor.probe import AZIMUTH_DEG, ProbePicture
from speckle3d.app.sensor.readings import Readings
from xsens.fusion.field import Trust
from xsens.logs.samples import ImuLog

_COLOURS = {
    Trust.YES: ("#2e7d32", "#edf6ee"),
    Trust.CARE: ("#c77700", "#fdf5e6"),
    Trust.NO: ("#b3261e", "#fcebea"),
    Trust.UNKNOWN: ("#6b7780", "#f1f3f4"),
}
_PLAY_MS = 100
_LEFT_PX = 350


class SensorPage:
    """What an orientation sensor read, and what follows from it.

    Parameters
    ----------
    log : ImuLog
    sensor_from_image : Rotation, optional
        How the sensor sits on the probe.

    Examples
    --------
    In a notebook:

    >>> import numpy as np
    >>> from speckle3d.app.sensor.page import SensorPage
    >>> from xsens import ImuLog
    >>> page = SensorPage(ImuLog(np.arange(300) / 100.0, gyroscope_rad_s=np.zeros((300, 3))))
    >>> view = page.view()
    """

    title = "Sensor"

    def __init__(self, log: ImuLog, sensor_from_image: Rotation | None = None) -> None:
        self._log, self._mounting = log, sensor_from_image

    @cached_property
    def _readings(self) -> Future[Readings]:
        """What is found of the log, once for all viewers."""
        with ThreadPoolExecutor(1) as worker:
            return worker.submit(Readings.of, self._log)

    def view(self) -> Viewable:
        """The sentence on the magnetometer above, the probe on the left, readings over time on the right."""
        readings = self._readings.result()
        plots = time_plots(readings)
        picture = ProbePicture(self._mounting)
        duration_s = self._log.duration_s
        when = pn.widgets.FloatSlider(
            name="time, s", start=0.0, end=max(duration_s, 1e-3), step=max(duration_s / 2000.0, 0.001),
            format="0.00", width=_LEFT_PX - 100,
        )  # fmt: skip
        play = pn.widgets.Toggle(name="play", width=70, align="end")
        side = pn.widgets.IntSlider(
            name="seen from, degrees from north to west", start=0, end=359, step=5, value=int(AZIMUTH_DEG),
            width=_LEFT_PX - 20,
        )  # fmt: skip
        words = pn.pane.HTML("", width=_LEFT_PX - 10)

        def show(_: object = None) -> None:
            now_s = float(when.value or 0.0)
            plots.point_at(now_s)
            held = readings.orientation_at(now_s)
            if held is not None:
                picture.turn(held)
            words.object = table(_now(readings, now_s, held))

        def step() -> None:
            on_s = float(when.value or 0.0) + _PLAY_MS / 1000.0
            when.value = 0.0 if on_s > duration_s else on_s

        def go(at_s: float) -> None:
            when.value = float(np.clip(at_s, 0.0, duration_s))

        clock = pn.state.add_periodic_callback(step, period=_PLAY_MS, start=False)
        play.param.watch(lambda event: clock.start() if event.new else clock.stop(), "value")
        when.param.watch(show, "value")
        side.param.watch(lambda event: picture.look_from(float(event.new)), "value")
        plots.on_tap(go)
        show()
        left = pn.Column(
            pn.pane.Bokeh(picture.plot), side, pn.Row(when, play, margin=0), words, width=_LEFT_PX, margin=0
        )
        right = pn.Column(
            *(pn.pane.Bokeh(each, sizing_mode="stretch_width", margin=0) for each in plots.finish()),
            pn.pane.HTML(_KEY, margin=(4, 10)),
            sizing_mode="stretch_width",
        )
        return pn.Column(
            banner(readings.trust, readings.sentence()),
            pn.Row(left, right, sizing_mode="stretch_width"),
            pn.pane.HTML(table(_facts(readings, self._mounting)), margin=(6, 10), max_width=1200),
            sizing_mode="stretch_width",
        )


_KEY = (
    '<span style="color:#6b7780"><span style="background:#e8a33d55">&emsp;</span> the field is hardly '
    'believed &emsp;<span style="color:#b3261e">|</span> samples are missing &emsp;'
    '<span style="background:#20507a40">&emsp;</span> 95 % band &emsp; '
    "click: go there; drag, wheel: move and zoom in time</span>"
)


def time_plots(readings: Readings) -> TimePlots:
    """Rates, field and heading over time; of what there is."""
    plots = TimePlots(readings.log.duration_s)
    if rates := readings.rates():
        plots.add("rate, \N{DEGREE SIGN}/s", rates, 125, legend=True)
    elif forces := readings.forces():
        plots.add("force, m/s\N{SUPERSCRIPT TWO}", forces, 125, legend=True)
    of_field = []
    if norm := readings.norm():
        of_field.append(plots.add("field / median", norm, 100))
    if dip := readings.dip():
        of_field.append(plots.add("dip, \N{DEGREE SIGN}", dip, 100))
    if (found := readings.heading()) is not None:
        heading, half = found
        of_field.append(plots.add("heading, \N{DEGREE SIGN}", [heading], 125))
        plots.band(of_field[-1], heading, half)
    plots.shade(readings.disbelieved(), DOUBT, of_field)
    plots.mark([at_s for at_s, _ in readings.gaps()], LOSS)
    if not plots.figures:
        plots.add("nothing read", [], 125)
    return plots


def banner(trust: Trust, sentence: str) -> Viewable:
    """The sentence on the magnetometer, coloured by what it says."""
    return pn.pane.HTML(banner_html(trust, sentence), margin=(8, 10), sizing_mode="stretch_width")


def banner_html(trust: Trust, sentence: str) -> str:
    """HTML of `banner`."""
    line, ground = _COLOURS[trust]
    style = (
        f"border-left:5px solid {line};background:{ground};padding:7px 12px;font-size:14px;line-height:1.4"
    )
    return f'<div class="magnetometer" style="{style}">{escape(sentence)}</div>'


def _now(readings: Readings, now_s: float, held: Rotation | None) -> list[tuple[str, str]]:
    if held is None:
        return [("orientation", "none: neither the sensor's own nor readings that tell it")]
    yaw, pitch, roll = held.as_euler("ZYX", degrees=True)
    rows = [
        (
            "roll, pitch, yaw",
            f"{roll:+.1f}\N{DEGREE SIGN}, {pitch:+.1f}\N{DEGREE SIGN}, {yaw:+.1f}\N{DEGREE SIGN}",
        )
    ]
    found = readings.found
    if found is not None:
        at = int(np.searchsorted(found.rotations.time_s - readings.start_s, now_s).clip(max=len(found) - 1))
        north, west, up = np.degrees(found.standard_deviation_rad[at])
        rows.append(
            (
                "standard deviation",
                f"inclination {max(north, west):.2f}\N{DEGREE SIGN}, heading {up:.1f}\N{DEGREE SIGN}",
            )
        )
        state = ["at rest" if found.resting[at] else "moving"]
        if found.magnetic:
            state.append("field hardly believed" if found.disturbed[at] else "field believed")
        rows.append(("state", ", ".join(state)))
    return rows


def _facts(readings: Readings, mounting: Rotation | None) -> list[tuple[str, str]]:
    log = readings.log
    rate = f"{log.rate_hz:.1f} samples/s" if np.isfinite(log.rate_hz) else "rate unknown"
    stream = readings.rotations()
    whose = "none" if stream is None else stream[2]
    return [
        ("log", f"{len(log)} samples, {log.duration_s:.1f} s, {rate}"),
        ("lost", readings.losses()),
        ("orientation", whose if not readings.why_not or stream is None else f"{whose}: {readings.why_not}"),
        ("world", readings.world()),
        (
            "probe",
            "as calibrated"
            if mounting is not None
            else "not calibrated: the sensor's axes drawn as the image's",
        ),
        *(("note", text) for text in readings.notes()),
    ]


def table(rows: list[tuple[str, str]]) -> str:
    """HTML of rows of name and value."""
    style = "color:#6b7780;padding:1px 12px 1px 0;white-space:nowrap;vertical-align:top"
    cell = f'<tr><td style="{style}">{{}}</td><td>{{}}</td></tr>'
    return f"<table>{''.join(cell.format(escape(name), escape(value)) for name, value in rows)}</table>"
