"""The sweep player: frames, their patches, flags, doubts and sensors."""

from collections.abc import Iterator, Sequence
from html import escape
from typing import Any

import numpy as np
import panel as pn
import param
from panel.viewable import Viewable

import speckle3d as s3
from speckle3d.app.look import batch_changes
from speckle3d.app.plots import greys
from speckle3d.app.sweep.plots import (
    FLAG_COLOUR,
    NEIGHBOURS,
    REASONS,
    PatchPlot,
    PatchValues,
    TimePlots,
    patch_values,
)
from speckle3d.config import stored_config
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import Doubt
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.examine.sensors import repair_readings
from speckle3d.matching.quality import FrameFlag

MOST_ROWS = 640
"""Rows that are sent to the browser: more than a screen shows, and a third of what echoes are sampled at."""
_MOST_DB, _USUAL_DB = 90, 50
"""Dynamic range of the images that are sent, and of what is shown of it at first."""

Stream = tuple[str, tuple[str, str, str], FloatArray, FloatArray]
"""Label, names of three parts, times on the images' clock, and values, shape (m, 3)."""


class SweepPage:
    """Frames of a sweep with a player, their patches, flags, doubts and sensors.

    Parameters
    ----------
    sweep : Sweep
    reconstruction : Reconstruction, optional
        Made from the sweep, with its frame pairs.
    doubts : sequence of Doubt, optional
        What the checks found as it was made; None if that is not known.
    """

    def __init__(
        self,
        sweep: s3.Sweep,
        reconstruction: s3.Reconstruction | None = None,
        doubts: Sequence[Doubt] | None = None,
    ) -> None:
        self.sweep = sweep
        toml = "" if reconstruction is None else reconstruction.config_toml
        config = stored_config(toml) if toml else s3.Config()
        self._images = s3.grey_images(sweep, _MOST_DB, reconstruction)
        grid = self._images.grid
        # Rows that are shown are means of so many samples.
        self._pooled = -(-grid.samples // MOST_ROWS)
        row_mm = self._pooled * grid.sample_spacing_mm
        first_mm = grid.first_sample_depth_mm + (row_mm - grid.sample_spacing_mm) / 2
        self.place = (grid.first_vector_mm, first_mm), (grid.vector_pitch_mm, row_mm)
        self.patch_mm = config.patches.width_mm, config.patches.height_mm
        self.pairs = None if reconstruction is None else reconstruction.pairs
        trust = None if reconstruction is None else reconstruction.trust
        self.flags = None if trust is None else trust.flags
        self.doubts = repair_readings(sweep)[1] if doubts is None else doubts

    def view(self) -> Viewable:
        """Frames with a player."""
        return _Player(self).layout()

    def image(self, frame: int) -> FloatArray:
        """Picture of a frame, shape (row, column), dB: 0 is white."""
        levels = self._images[frame].T
        rows = levels[: len(levels) // self._pooled * self._pooled].reshape(-1, self._pooled, levels.shape[1])
        return np.asarray(_MOST_DB * (rows.mean(axis=1) / 255.0 - 1.0))


class _Player(param.Parameterized):  # type: ignore[misc]
    """View of a sweep for one viewer."""

    frame = param.Integer(0)
    colour = param.Selector(label="patches coloured by")
    lag = param.Integer(-1, bounds=(-NEIGHBOURS, NEIGHBOURS), label="partner, frames from this one")
    range_db = param.Integer(_USUAL_DB, bounds=(30, _MOST_DB), label="dynamic range / dB")

    def __init__(self, page: SweepPage) -> None:
        self._page = page
        self.param.frame.bounds = (0, max(len(page.sweep) - 1, 1))
        self.param.colour.objects = {"distance": "distance", "standard deviation": "sigma", "none": "none"}
        super().__init__(colour="distance" if page.pairs is not None and len(page.pairs) else "none")
        self._picture = PatchPlot(page.patch_mm)
        self._times = TimePlots(
            page.sweep, lambda frame: setattr(self, "frame", frame), page.flags, page.doubts
        )
        self._text = pn.pane.HTML("", sizing_mode="stretch_width")
        self.param.watch(self._draw, ["frame", "colour", "lag", "range_db"])
        self._draw()

    def layout(self) -> Viewable:
        """The image on the left, as high as the window; all else on the right."""
        sweep, wide = self._page.sweep, {"sizing_mode": "stretch_width"}
        player = pn.widgets.Player.from_param(
            self.param.frame,
            interval=max(round(1000 * self._times.interval_s), 10),
            show_value=True,
            show_loop_controls=False,
            disabled=len(sweep) == 1,
            height=75,
            **wide,
        )
        colour = pn.widgets.RadioButtonGroup.from_param(self.param.colour, button_style="outline")
        streams = [pn.pane.Bokeh(self._times.stream(*stream), **wide) for stream in streams_of(sweep)]
        lag, levels = (
            pn.widgets.IntSlider.from_param(setting, width=215)
            for setting in (self.param.lag, self.param.range_db)
        )
        patches = [pn.Row(pn.pane.HTML("<b>patches coloured by</b>", margin=(10, 5)), colour), lag]
        right = pn.Column(
            player,
            *(patches if self.colour != "none" else []),
            levels,
            self._text,
            *(pn.pane.HTML(f"&bull; {escape(str(doubt))}") for doubt in self._page.doubts),
            pn.pane.Bokeh(self._times.marks, **wide),
            *(streams or [pn.pane.HTML("No sensor was recorded with this sweep.")]),
            sizing_mode="stretch_both",
            scroll="y-auto",
        )
        left = pn.pane.Bokeh(self._picture.plot, sizing_mode="stretch_both", max_width=700)
        return pn.Row(left, right, sizing_mode="stretch_both")

    @batch_changes
    def _draw(self, *_: Any) -> None:
        page, frame, values, most = self._page, self.frame, None, 1.0
        # Where the sweep ends, the other way.
        partner = frame + self.lag if 0 <= frame + self.lag < len(page.sweep) else frame - self.lag
        if (pairs := page.pairs) is not None and self.colour != "none":
            values = patch_values(pairs, page.sweep.grid, frame, partner)
            # What all but a hundredth of the patches of pairs as far apart stay below.
            alike = pairs.second - pairs.first == abs(self.lag)
            if values is not None:
                most = float(np.nanpercentile(getattr(pairs, f"{self.colour}_mm")[alike], 99))
        self._picture.show(greys(page.image(frame), -self.range_db, 0.0), *page.place)
        self._picture.colour(values, self.colour, most)
        self._times.move(frame)
        self._text.object = "<br>".join(self._words(frame, partner, values))

    def _words(self, frame: int, partner: int, values: PatchValues | None) -> Iterator[str]:
        """Displayed text, as HTML."""
        time_s, flags = self._page.sweep.frame_time_s, self._page.flags
        yield f"<b>Frame {frame}</b> of 0 to {len(time_s) - 1}, at {time_s[frame] - time_s[0]:.3f} s"
        if flags is not None:
            yield f"{np.count_nonzero(flags) or 'None'} of {len(time_s)} frames flagged"
            for flag in FrameFlag(int(flags[frame])):
                yield f'<span style="color:{FLAG_COLOUR}">&#9873; {escape(REASONS[flag])}</span>'
        if values is not None:
            elevation, sigma = values["elevation"]
            yield (
                f"<b>With frame {partner}</b>: the image's centre is {elevation:.3f} mm away, elevational "
                f"(standard deviation {sigma:.3f})"
            )
            left_out = np.isfinite(values["distance"]) & ~values["inliers"]
            yield f"{values['inliers'].sum()} patches used, {left_out.sum()} left out (red crosses)"
        elif self.colour != "none":
            yield f"The reconstruction did not use the pair with frame {partner}."


def streams_of(sweep: s3.Sweep) -> Iterator[Stream]:
    """Rotation and motion of the image by a sweep's sensors, or of uncalibrated sensors."""
    orientation, tracker = sweep.orientation, sweep.tracker
    if orientation is not None:
        turns, names = orientation.readings.world_from_sensor, ("x", "y", "z")
        if orientation.sensor_from_image is not None:
            turns, names = turns * orientation.sensor_from_image, ("tilt", "yaw", "roll")
        yield "sensor / °", names, *_with_gaps(orientation, np.degrees((turns[0].inv() * turns).as_rotvec()))
    if tracker is not None:
        poses, names, at = tracker.readings.world_from_sensor, ("x", "y", "z"), np.zeros(3)
        if tracker.sensor_from_image is not None:
            poses, names = poses * tracker.sensor_from_image, ("lateral", "axial", "elevational")
            at = sweep.grid.centre_mm
        yield "tracker / mm", names, *_with_gaps(tracker, (poses[0].inv() * poses).apply(at) - at)


def _with_gaps(sensor: OrientationSensor | Tracker, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Times on the images' clock and values, with a break where readings are too far apart to be joined."""
    time_s = sensor.readings.time_s + sensor.time_offset_s
    gaps = np.flatnonzero(np.diff(time_s) > sensor.readings.max_gap_s) + 1
    return np.insert(time_s, gaps, time_s[gaps]), np.insert(values, gaps, np.nan, axis=0)
