"""What both tuners have: frames, the picture, the settings, and the calibration."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy.typing as npt
import panel as pn
from panel.viewable import Viewable
from pydantic import BaseModel

from calibration.points import Recording, Seen
from speckle3d.app.folder import Folder
from speckle3d.app.look import batched
from speckle3d.app.phantom.plots import DROPPED, USED, FramePlot, FrameStrip
from speckle3d.app.phantom.run import RunPane, Solved, sentence
from speckle3d.calibrating.phantoms import BY_HAND, found, require_frames
from speckle3d.calibrating.settings import (
    PlaneSettings,
    ScanSettings,
    with_values,
)
from speckle3d.core.errors import InvalidInputError, Speckle3DError

_WIDTH_PX = 285
_SLIDERS: dict[str, tuple[str, float, float, float]] = {
    "columns": ("n, columns", 5, 240, 1),
    "smoothing_mm": ("σ, smoothing / mm", 0.05, 3.05, 0.05),
    "threshold": ("T / levels per mm, 0: automatic", 0.0, 300.0, 1.0),
    "tolerance_mm": ("d, tolerance / mm", 0.05, 3.05, 0.05),
    "consensus": ("p, share that agrees", 0.05, 1.0, 0.01),
}
"""Label, least, greatest and step of settings that are tuned by sliders."""
_REFLECTORS = {"(choose before the first run)": "", "a bare wall": "wall", "a thin bar (Cambridge)": "bar"}


class PhantomViewer:
    """What one viewer sees of a phantom's recording, and has set: the values of its widgets.

    Parameters
    ----------
    recording : Recording
    images : Path
        Its file, as the command is given it.
    folder : Folder
        Where results are saved.
    given : ScanSettings
        To begin with.
    """

    detection: tuple[str, ...] = ()
    """Settings of what is found, which change what is seen at once."""
    more: tuple[str, ...] = ()
    """Those of the calibration, folded away."""

    def __init__(self, recording: Recording, images: Path, folder: Folder, given: ScanSettings) -> None:
        self.recording, self.images, self.folder, self._given = recording, images, folder, given
        count = recording.images.shape[0]
        self.widgets = {
            name: widget(given, name) for name in (*self.detection, "region", "leave_out", *self.more)
        }
        self._used: dict[int, str] = {}
        self._dropped: dict[int, str] = {}
        self.frame_plot = FramePlot(recording, self._draw_region)
        self._strip = FrameStrip(count, self.go, self._toggle)
        # A slider needs two values.
        self._slider = pn.widgets.IntSlider(
            name="frame", end=max(count - 1, 1), disabled=count < 2, sizing_mode="stretch_width"
        )
        self._said = pn.pane.HTML("", sizing_mode="stretch_width")
        self._run = RunPane(
            recording, images, folder, self._to_run, self.find, self._solved, self.before_saving
        )
        if isinstance(given, PlaneSettings):
            # A thin bar that is taken for a wall is warned of for a bias that it does not have.
            self.widgets["reflector"] = pn.widgets.Select(
                name="what the plane is", options=_REFLECTORS, width=_WIDTH_PX
            )
        self._slider.param.watch(self._show, "value")
        for each in self.widgets.values():
            each.param.watch(self.changed, "value")

    def layout(self, *parts: Viewable) -> Viewable:
        """The picture on the left; on the right what is tuned, and the calibration."""
        left = pn.Column(
            self._slider,
            pn.pane.Bokeh(self.frame_plot.plot, sizing_mode="stretch_both"),
            self._said,
            pn.pane.Bokeh(self._strip.plot, sizing_mode="stretch_width"),
            sizing_mode="stretch_both",
        )
        area = pn.Row(self.widgets["region"], self.widgets["leave_out"])
        more = [self.widgets[name] for name in self.more]
        folded = pn.Card(*more, title="More settings of the calibration", collapsed=True, width=610)
        asked = [self.widgets["reflector"]] if "reflector" in self.widgets else []
        right = pn.Column(
            *parts, area, *asked, self._run.view(), folded, scroll="y-auto", sizing_mode="stretch_both"
        )
        self._show()
        return pn.Row(left, right, sizing_mode="stretch_both")

    @property
    def frame(self) -> int:
        """Number of the frame that is looked at."""
        return int(self._slider.value or 0)

    def go(self, frame: int) -> None:
        """Look at another frame."""
        self._slider.value = frame

    def settings(self) -> ScanSettings:
        """The settings as they stand.

        Raises
        ------
        InvalidInputError, MismatchError
            If they are none, or do not fit the recording.
        """
        values: dict[str, Any] = {name: each.value for name, each in self.widgets.items()}
        # A slider at zero, and what is not chosen yet.
        unset = {
            name
            for name in ("threshold", "reflector", "time_offset_s")
            if name in values and not values[name]
        }
        settings = with_values(self._given, {name: values[name] for name in values if name not in unset})
        require_frames(settings.frames_left_out, self.recording.images.shape[0])
        return settings

    def changed(self, *_: Any) -> None:
        """What is set is something else."""
        self._run.outdate()
        self._show()

    def show(self, image: npt.NDArray[Any], settings: ScanSettings) -> str:
        """Draw what is found in a frame, and return what to say; raise `Speckle3DError` where nothing is."""
        raise NotImplementedError

    def find(self, settings: ScanSettings) -> Seen:
        """Find the phantom in all frames."""
        return found(self.recording, settings)

    def before_saving(self, settings: ScanSettings, out: Path) -> ScanSettings:
        """Bring the settings of a run into what a command can be given."""
        return settings

    def tell(self, words: str, colour: str = USED) -> None:
        """Say something below the picture."""
        self._said.object = sentence(words, colour, "phantom-told")

    def mark_used(self, frames: dict[int, str]) -> None:
        """Say which frames have something, and forget what became of them before."""
        self._used, self._dropped = frames, {}
        self._show()

    @batched
    def _show(self, *_: Any) -> None:
        try:
            settings = self.settings()
        except Speckle3DError as error:
            self.tell(str(error), DROPPED)
            return
        left_out = dict.fromkeys(settings.frames_left_out, BY_HAND)
        self._strip.show(self.frame, self._used, self._dropped, left_out)
        image = self.frame_plot.show_frame(self.frame, settings.corners)
        try:
            self.tell(self.show(image, settings))
        except Speckle3DError as error:
            self.tell(str(error), DROPPED)

    def _to_run(self) -> ScanSettings:
        if "reflector" in self.widgets and not self.widgets["reflector"].value:
            raise InvalidInputError("say first what the plane is: a bare wall, or a thin bar")
        return self.settings()

    def _toggle(self, frame: int) -> None:
        with suppress(Speckle3DError):  # which is shown
            frames = {*self.settings().frames_left_out} ^ {frame}
            self.widgets["leave_out"].value = ",".join(map(str, sorted(frames)))

    def _draw_region(self, corners: npt.NDArray[Any]) -> None:
        # A mouse knows no more than a tenth of a pixel, and a command can be given that.
        self.widgets["region"].value = " ".join(f"{column:.1f},{row:.1f}" for column, row in corners)

    @batched
    def _solved(self, run: Solved) -> None:
        self._used = {} if run.seen is None else dict.fromkeys(map(int, run.seen.frame), "found")
        self._dropped = {} if run.seen is None else dict(run.seen.dropped)
        if run.outcome is not None:
            frames = run.outcome.calibration.frames
            self._used, self._dropped = dict.fromkeys(frames.used, "used"), dict(frames.dropped)
        self._show()


def widget(settings: BaseModel, name: str) -> Any:
    """Make the widget of a setting, which has its value; its description is the field's."""
    field, value = type(settings).model_fields[name], getattr(settings, name)
    label, look = name.replace("_", " "), {"width": _WIDTH_PX, "margin": (2, 8)}
    options = {"description": field.description, **look}
    if name in _SLIDERS:
        label, low, high, step = _SLIDERS[name]
        kind = pn.widgets.IntSlider if isinstance(field.default, int) else pn.widgets.FloatSlider
        value, default = value or 0.0, field.default or 0.0
        ends = {"start": min(low, value), "end": max(high, value), "step": step}
        return kind(name=f"{label} (default {default:g})", value=value, **ends, **look)
    if isinstance(field.default, bool):
        return pn.widgets.Checkbox(name=field.description, value=value, **look)
    if get_origin(field.annotation) is Literal:
        return pn.widgets.Select(name=label, options=list(get_args(field.annotation)), value=value, **options)
    if isinstance(field.default, float):
        return pn.widgets.FloatInput(name=f"{label} (default {field.default:g})", value=value, **options)
    text = "" if value is None else str(value)
    return pn.widgets.TextInput(name=label, value=text, placeholder=field.description, **look)
