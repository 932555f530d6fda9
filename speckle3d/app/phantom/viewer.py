"""Base of both phantom tuners: frames, their picture, the settings, and the calibration with its result."""

import asyncio
import html
import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import panel as pn
from panel.viewable import Viewable
from pydantic import BaseModel

from calibration.points import Detections, Recording
from calibration.recording import Outcome
from calibration.report import text_report
from speckle3d.app.look import batch_changes
from speckle3d.app.phantom.plots import BLUE, ORANGE, FramePlot, FrameStrip
from speckle3d.calibrating.phantoms import (
    BY_HAND,
    detect_phantom,
    remarks,
    require_frames,
    solve_phantom,
    write_outcome,
)
from speckle3d.calibrating.settings import PlaneSettings, ScanSettings, with_values
from speckle3d.calibrating.written import BESIDE
from speckle3d.core.arrays import AnyArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError

_Result = TypeVar("_Result")

_AMBER = "#9a6700"
"""Of a result that more motion would improve."""
_REFLECTORS = {"(choose before the first run)": "", "a bare wall": "wall", "a thin bar (Cambridge)": "bar"}


class PhantomViewer:
    """View of a phantom's recording for one viewer, with the values of its widgets.

    Parameters
    ----------
    recording : Recording
    images : Path
        Its file, as the command is given it.
    settings : ScanSettings
        To begin with.
    """

    detection: tuple[str, ...] = ()
    """Settings of what is found, which change what is seen at once."""

    def __init__(self, recording: Recording, images: Path, settings: ScanSettings) -> None:
        self.recording, self.images, self._start = recording, images, settings
        self.folder = images.resolve().parent
        count = recording.images.shape[0]
        names = (*self.detection, "region", "leave_out")
        self.widgets = {name: widget(settings, name) for name in names}
        if isinstance(settings, PlaneSettings):
            # A thin bar that is taken for a wall is warned of for a bias that it does not have.
            self.widgets["reflector"] = pn.widgets.Select(
                name="what the plane is", options=_REFLECTORS, width=WIDTH_PX
            )
        self._uses: dict[int, str] = {}
        self._refusals: dict[int, str] = {}
        self._result: tuple[ScanSettings, Outcome] | None = None
        self.frame_plot = FramePlot(recording, self._draw_region)
        self._strip = FrameStrip(count, self.go, self._toggle)
        # A slider needs two values.
        self._slider = pn.widgets.IntSlider(
            name="frame", end=max(count - 1, 1), disabled=count < 2, sizing_mode="stretch_width"
        )
        self._words = pn.pane.HTML("", sizing_mode="stretch_width")
        self._button = pn.widgets.Button(
            name="Run calibration", button_type="primary", width=150, align="end"
        )
        self._verdict = pn.pane.HTML(sentence("Not calibrated yet.", "#555555"), width=600)
        self._stale = pn.pane.HTML(
            sentence("Settings changed since this run: run again.", ORANGE), visible=False
        )
        self._table, self._note = pn.pane.HTML("", width=600), pn.pane.HTML("", width=600)
        self._name = pn.widgets.TextInput(
            name="file of the result", value=f"{images.stem}-calibration.h5", width=300
        )
        self._save = pn.widgets.Button(name="Save result", width=110, disabled=True, align="end")
        self._slider.param.watch(self._show, "value")
        for control in self.widgets.values():
            control.param.watch(self.changed, "value")
        self._button.on_click(self._calibrate)
        self._save.on_click(self._write_result)

    def layout(self, *parts: Viewable) -> Viewable:
        """The picture on the left; on the right what is tuned, the button, the verdict and the table."""
        left = pn.Column(
            self._slider,
            pn.pane.Bokeh(self.frame_plot.plot, sizing_mode="stretch_both"),
            self._words,
            pn.pane.Bokeh(self._strip.plot, sizing_mode="stretch_width"),
            sizing_mode="stretch_both",
        )
        right = pn.Column(
            *parts,
            pn.Row(self.widgets["region"], self.widgets["leave_out"]),
            pn.Row(self._button, self._save, self._name),
            self._stale,
            self._verdict,
            self._note,
            self._table,
            scroll="y-auto",
            sizing_mode="stretch_both",
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
        values: dict[str, Any] = {name: control.value for name, control in self.widgets.items()}
        for name in ("threshold", "reflector"):  # a slider at zero, and what is not chosen yet
            if not values.get(name):
                values.pop(name, None)
        settings = with_values(self._start, values)
        require_frames(settings, self.recording)
        return settings

    def changed(self, *_: Any) -> None:
        """Show the settings as they are now; a result of others, or a run's to come, cannot be saved."""
        self._stale.visible = self._button.loading or self._result is not None
        self._save.disabled = True
        self._show()

    def show(self, image: AnyArray, settings: ScanSettings) -> str:
        """Draw what is found in a frame, and return what to say; raise `Speckle3DError` where nothing is."""
        raise NotImplementedError

    def find(self, settings: ScanSettings) -> Detections:
        """Find the phantom in all frames; called in a thread."""
        return detect_phantom(self.recording, settings)

    def before_saving(self, settings: ScanSettings, out: Path) -> ScanSettings:
        """Bring the settings of a run into what a command can be given, as by saving points set by hand."""
        return settings

    def tell(self, words: str, colour: str = BLUE) -> None:
        """Say something below the picture."""
        self._words.object = sentence(words, colour, "phantom-told")

    def mark_frames(self, uses: dict[int, str], refusals: dict[int, str]) -> None:
        """Say which frames have something and which not, in place of what became of them before."""
        self._uses, self._refusals = uses, refusals
        self._show()

    @batch_changes
    def _show(self, *_: Any) -> None:
        try:
            settings = self.settings()
        except Speckle3DError as error:
            self.tell(str(error), ORANGE)
            return
        left_out = dict.fromkeys(settings.frames_left_out, BY_HAND)
        self._strip.show(self.frame, self._uses, self._refusals, left_out)
        image = self.frame_plot.show_frame(self.frame, settings.corners)
        try:
            self.tell(self.show(image, settings))
        except Speckle3DError as error:
            self.tell(str(error), ORANGE)

    def _toggle(self, frame: int) -> None:
        with suppress(Speckle3DError):  # which is shown
            frames = {*self.settings().frames_left_out} ^ {frame}
            self.widgets["leave_out"].value = ",".join(map(str, sorted(frames)))

    def _draw_region(self, corners: AnyArray) -> None:
        # A mouse knows no more than a tenth of a pixel, and a command can be given that.
        self.widgets["region"].value = " ".join(f"{column:.1f},{row:.1f}" for column, row in corners)

    async def _calibrate(self, _: object) -> None:
        points, self._result, self._note.object = None, None, ""
        self._save.disabled, self._stale.visible = True, False
        try:
            if "reflector" in self.widgets and not self.widgets["reflector"].value:
                raise InvalidInputError("say first what the plane is: a bare wall, or a thin bar")
            settings = self.settings()
            points = await run_in_thread(self._button, partial(self.find, settings))
            outcome = await run_in_thread(
                self._button, partial(solve_phantom, self.recording, points, settings)
            )
        except Speckle3DError as error:
            self._verdict.object, self._table.object = sentence(f"No calibration: {error}", ORANGE), ""
            uses = {} if points is None else dict.fromkeys(map(int, points.frame), "found")
            self.mark_frames(uses, {} if points is None else dict(points.dropped))
            return
        self._result, self._save.disabled = (settings, outcome), self._stale.visible
        calibration, lacking = outcome.calibration, outcome.solution.adequacy.missing
        self._verdict.object = sentence(calibration.verdict, _AMBER if lacking else BLUE)
        table = text_report(calibration, outcome.beam, remarks(outcome))
        self._table.object = (
            f"<pre class='calibration' style='margin:0;white-space:pre-wrap'>{html.escape(table)}</pre>"
        )
        self.mark_frames(dict.fromkeys(calibration.frames.used, "used"), dict(calibration.frames.dropped))

    def _write_result(self, _: object) -> None:
        if self._result is None:
            return
        settings, outcome = self._result
        try:
            out = new_path(self.folder, self._name.value or "", ".h5")
            for suffix in BESIDE:
                new_path(self.folder, out.stem, suffix)
            settings = self.before_saving(settings, out)
            files = write_outcome(outcome, settings, self.images, out, remarks(outcome)).files
        except Speckle3DError as error:
            self._note.object = sentence(str(error), ORANGE)
            return
        names = ", ".join(path.name for path in files)
        self._note.object = sentence(f"Saved {names} in {self.folder}", BLUE)


async def run_in_thread(button: pn.widgets.Button, work: Callable[[], _Result]) -> _Result:
    """Do work in a thread; the button turns and cannot be clicked meanwhile."""
    button.disabled = button.loading = True
    try:
        return await asyncio.to_thread(work)
    finally:
        button.disabled = button.loading = False


def sentence(words: str, colour: str, name: str = "verdict") -> str:
    """HTML of a sentence."""
    return f"<div class='{name}' style='color:{colour};font-weight:600'>{html.escape(words)}</div>"


def new_path(folder: Path, name: str, suffix: str) -> Path:
    """Path of a new file in a folder, named in a save dialogue with or without its suffix.

    Raises
    ------
    InvalidInputError
        If the name is not that of a file in the folder itself, or is taken.
    """
    path = folder / f"{name.removesuffix(suffix)}{suffix}"
    if path.parent != folder or path.name.startswith(".") or not name.isprintable():
        raise InvalidInputError(f"expected the name of a file in {folder}, got {name!r}")
    if os.path.lexists(path):
        raise InvalidInputError(f"{path}: expected a new name, got one that is taken")
    return path


WIDTH_PX = 285
_SLIDERS: dict[str, tuple[str, float, float, float]] = {
    "columns": ("n, columns", 5, 240, 1),
    "smoothing_mm": ("σ, smoothing / mm", 0.05, 3.05, 0.05),
    "threshold": ("T / levels per mm, 0: auto", 0.0, 300.0, 1.0),
    "tolerance_mm": ("d, tolerance / mm", 0.05, 3.05, 0.05),
    "consensus": ("p, share that agrees", 0.05, 1.0, 0.01),
}
"""Label, least, greatest and step of settings that are tuned by sliders."""


def widget(settings: BaseModel, name: str) -> Any:
    """Make the widget of a setting, which has its value; its description is the field's."""
    field, value = type(settings).model_fields[name], getattr(settings, name)
    label, look = name.replace("_", " "), {"width": WIDTH_PX, "margin": (2, 8)}
    if name in _SLIDERS:
        label, low, high, step = _SLIDERS[name]
        kind = pn.widgets.IntSlider if isinstance(field.default, int) else pn.widgets.FloatSlider
        value, default = value or 0.0, field.default or 0.0
        ends = {"start": min(low, value), "end": max(high, value), "step": step}
        return kind(name=f"{label} (default {default:g})", value=value, **ends, **look)
    return pn.widgets.TextInput(name=label, value=value, placeholder=field.description, **look)
