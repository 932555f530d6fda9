"""The tuner of line detection: the live line under sliders, a region, frames left out, and the calibration.

References
----------
.. [1] R. W. Prager et al., "Rapid calibration for 3-D freehand ultrasound", Ultrasound Med. Biol. 24, 1998,
   figure 16.
"""

from __future__ import annotations

import html
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource
from panel.viewable import Viewable

from calibration.detection.lines import EchoLine, LineFinder, NoLineError
from calibration.points import Seen
from calibration.recording import Recording
from calibration.settings import LineSettings
from speckle3d.app.folder import Folder
from speckle3d.app.phantom.frames import FrameChoice
from speckle3d.app.phantom.marked import slider, widget
from speckle3d.app.phantom.options import Options
from speckle3d.app.phantom.picture import DROPPED, FOUND, USED, Picture
from speckle3d.app.phantom.region import Region
from speckle3d.app.phantom.run import RunPane, Solved, labelled
from speckle3d.app.phantom.work import in_turn
from speckle3d.calibrating.phantoms import found
from speckle3d.calibrating.settings import (
    OrientationSettings,
    PlaneSettings,
    ScanSettings,
    with_values,
)
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import Progress

_WIDTH, _HEIGHT = 590, 400
_STEEPEST = 300.0
_EDGE = 50.0
"""Slope, grey levels per mm, at which the slider of the threshold begins."""


class LinesPage:
    """Lines of a plane in the frames of a recording, found as the sliders say.

    Parameters
    ----------
    recording : Recording
        As from `speckle3d.calibrating.recordings.open_recording`.
    images : Path
        Its file, as the command is given it.
    folder : Folder
        Where results are saved.
    settings : PlaneSettings or OrientationSettings
        To begin with.
    """

    title = "Lines"

    def __init__(
        self,
        recording: Recording,
        images: Path,
        folder: Folder,
        settings: PlaneSettings | OrientationSettings | None = None,
    ) -> None:
        self._recording, self._images, self._folder = recording, images, folder
        self._settings = settings or PlaneSettings()

    def view(self) -> Viewable:
        """Return the page of one viewer."""
        return _Tuner(self._recording, self._images, self._folder, self._settings).layout()


class _Tuner:
    """What one viewer sees and has set."""

    def __init__(
        self,
        recording: Recording,
        images: Path,
        folder: Folder,
        settings: PlaneSettings | OrientationSettings,
    ) -> None:
        self._recording, self._given = recording, settings
        self._finder: tuple[object, LineFinder] | None = None
        self._picture = Picture(recording, _WIDTH, _HEIGHT)
        self._region = Region(self._picture.plot, settings.region, self._changed)
        count = recording.images.shape[0]
        self._frames = FrameChoice(count, _WIDTH, settings.leave_out, self._show, self._changed)
        self._sliders = _sliders(settings)
        self._automatic = pn.widgets.Checkbox(
            name="T: by brightness (default)", value=settings.threshold is None, margin=(6, 8)
        )
        self._place = widget(LineSettings, "place")
        self._place.value = settings.place
        self._told = pn.pane.HTML("", width=_WIDTH)
        self._options = Options(settings, self._changed)
        self._line = ColumnDataSource({"column": [], "row": []}, name="line")
        self._inliers = ColumnDataSource({"column": [], "row": []})
        plot = self._picture.plot
        plot.line("column", "row", source=self._line, color=FOUND, line_width=2)
        plot.scatter("column", "row", source=self._inliers, size=6, line_color=DROPPED, fill_color=None)
        self._run = RunPane(recording, images, folder, self.settings, self._found, self._solved)
        self._watch()
        self._show()

    def layout(self) -> Viewable:
        reset = pn.widgets.Button(name="Defaults", width=90)
        reset.on_click(in_turn(self._reset))
        s = self._sliders
        detection = pn.Column(
            pn.Row(s["columns"], s["smoothing_mm"]),
            pn.Row(pn.Column(self._automatic, s["threshold"]), s["tolerance_mm"]),
            pn.Row(s["consensus"], self._place),
        )
        left = pn.Column(
            self._frames.slider, pn.pane.Bokeh(self._picture.plot), self._told, self._frames.below()
        )
        hint = pn.pane.HTML(
            "In the image: the line found (blue) and the edges that agree with it (orange rings).<br>"
            "Region: drag a box in the image; or, by the polygon tool: hold down, click corners, hold down.",
            margin=(2, 8),
        )
        right = pn.Column(
            labelled("Line detection (orange mark: default)", detection),
            pn.Row(reset, self._region.controls()),
            hint,
            self._options.view(),
            self._run.view(),
        )
        return pn.Row(left, right)

    def settings(self) -> ScanSettings:
        """The settings as they stand on the page."""
        values: dict[str, Any] = {name: round(each.value, 6) for name, each in self._sliders.items()}
        if self._automatic.value:
            values["threshold"] = None
        values |= self._options.values() | {
            "place": self._place.value,
            "region": self._region.corners,
            "leave_out": self._frames.left_out,
        }
        return with_values(self._given, values)

    def _watch(self) -> None:
        for each in (*self._sliders.values(), self._automatic, self._place):
            each.param.watch(in_turn(self._changed), "value")

    def _reset(self) -> None:
        fields = LineSettings.model_fields
        for name, each in self._sliders.items():
            if fields[name].default is not None:
                each.value = fields[name].default
        self._automatic.value, self._place.value = True, fields["place"].default

    def _changed(self) -> None:
        self._sliders["threshold"].disabled = self._automatic.value
        self._run.outdate()
        self._show()

    def _show(self) -> None:
        image = self._picture.show(self._frames.frame)
        try:
            line = self._line_finder().line(image)
        except (NoLineError, InvalidInputError) as error:
            self._line.data = self._inliers.data = {"column": [], "row": []}
            self._tell(str(error), DROPPED)
            return
        self._draw(line)

    def _line_finder(self) -> LineFinder:
        settings = self.settings()
        assert isinstance(settings, PlaneSettings | OrientationSettings)
        lines, region = settings, settings.region
        # What is looked at depends on these alone; the rest must follow the slider at once.
        key = lines.columns, lines.smoothing_mm, region
        if self._finder is None or self._finder[0] != key:
            images, size = self._recording.images, self._recording.pixel_mm
            self._finder = key, LineFinder.of_frames(images, size, lines, settings.region)
        return replace(self._finder[1], settings=lines)

    def _draw(self, line: EchoLine) -> None:
        (u, v), (w, x) = line.points_px
        across = np.array([-0.5, self._recording.images.shape[1] - 0.5])
        self._line.data = {"column": across, "row": v + (x - v) / (w - u) * (across - u)}
        self._inliers.data = {"column": line.inlier_px[:, 0], "row": line.inlier_px[:, 1]}
        middle = v + (x - v) / (w - u) * (float(across.mean()) - u)
        self._tell(
            f"line: {line.consensus} of {line.possible} columns agree; row {middle:.2f} in the middle, "
            f"+- {line.point_sd_mm:.3f} mm and {np.rad2deg(line.direction_sd_rad):.3f} deg",
            USED,
        )

    def _tell(self, words: str, colour: str) -> None:
        self._told.object = f"<span class='line-told' style='color:{colour}'>{html.escape(words)}</span>"

    def _found(self, settings: ScanSettings, progress: Progress) -> Seen:
        return found(self._recording, settings, None, progress)

    def _solved(self, run: Solved) -> None:
        self._frames.strip.tell(run.seen, run.outcome)


def _sliders(settings: PlaneSettings | OrientationSettings) -> dict[str, Any]:
    made = {
        "columns": slider(LineSettings, "columns", "n, columns", (5, 240), 1),
        "smoothing_mm": slider(LineSettings, "smoothing_mm", "σ, smoothing / mm", (0.05, 3.05), 0.05),
        "threshold": pn.widgets.FloatSlider(
            name="T, slope / levels per mm", start=1.0, end=_STEEPEST, step=1.0, value=_EDGE, width=285,
            margin=(2, 8), disabled=settings.threshold is None,
        ),
        "tolerance_mm": slider(LineSettings, "tolerance_mm", "d, tolerance / mm", (0.05, 3.05), 0.05),
        "consensus": slider(LineSettings, "consensus", "p, share that agrees", (0.05, 1.0), 0.01),
    }  # fmt: skip
    for name, each in made.items():
        if (value := getattr(settings, name)) is not None:
            each.param.update(start=min(each.start, value), end=max(each.end, value), value=value)
    return made
