"""One viewer of a reconstruction: controls, cuts, trajectories and measurements, wired together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from panel.viewable import Viewable

from speckle3d.app.folder import Folder
from speckle3d.app.reconstruction.cutter import Cutter
from speckle3d.app.reconstruction.cuts_view import CutsView
from speckle3d.app.reconstruction.free_plane import FreePlane
from speckle3d.app.reconstruction.material import Material
from speckle3d.app.reconstruction.shown import Name, Shown
from speckle3d.core.arrays import FloatArray
from speckle3d.study.figures import label_of
from speckle3d.study.reslices.cuts import CutPicture

_SIDE_PX = 290
_ALONE = "nothing"
_SOON_MS = 15


class Viewer:
    """State and widgets of one viewer.

    Parameters
    ----------
    material : Material
        Shared with other viewers.
    folder : Folder
    sweep_file : path, optional
        As for `ReconstructionPage`.
    """

    def __init__(self, material: Material, folder: Folder, sweep_file: Path | None) -> None:
        self._material, self._folder, self._sweep_file = material, folder, sweep_file
        self._document = pn.state.curdoc
        grid, frames = material.grid, len(material.reconstruction.frame_time_s)
        middle = (grid.first_sample_depth_mm + grid.depth_mm) / 2
        self.shown = Shown(
            material.modes[0], None, False, frames // 2, round(grid.width_mm / 2, 2), round(middle, 2),
            FreePlane(0.0, 45.0, 0.0),
        )  # fmt: skip
        self._setting = self._is_drawing_due = False
        self._add_widgets(grid.width_mm, (grid.first_sample_depth_mm, grid.depth_mm), frames)
        self._cuts = CutsView(material, self.change, self._pick)
        self._cuts.shown = self.shown
        self._cutter = Cutter(material, self._told)

    def view(self) -> Viewable:
        """Lay everything out and begin."""
        self._begin()
        self._draw()
        self._cutter.ask(self.shown)
        side = pn.Column(
            self._mode, self._other, self._style, self._frame, self._lateral, self._depth,
            pn.pane.Markdown("**Free plane**"), self._shift, self._turn, self._tilt, self._status, width=_SIDE_PX,
        )  # fmt: skip
        return pn.Row(side, self._cuts.layout())

    def change(self, **changes: Any) -> None:
        """Show something else; what is drawn follows soon, so that many changes are drawn once."""
        before, self.shown = self.shown, replace(self.shown, **changes)
        self._cuts.shown = self.shown
        if self.shown == before:
            return
        if self.shown.modes != before.modes or self.shown.is_difference != before.is_difference:
            self._begin()
        self._cutter.ask(self.shown)
        if not self._is_drawing_due:
            self._is_drawing_due = True
            self._later(self._draw, _SOON_MS)

    def _begin(self) -> None:
        """Make room for the modes, and have their voxels made."""
        beside = self.shown.other is not None and not self.shown.is_difference
        self._cuts.lay_out_for(beside)
        for mode in self.shown.modes:
            self._material.ask_for_voxels(mode, self._tell_progress)
        self._cutter.forget()

    def _draw(self) -> None:
        self._is_drawing_due = False
        with pn.io.hold(self._document):
            self._set_widgets()
            self._cuts.draw()

    def _add_widgets(self, width_mm: float, depths_mm: tuple[float, float], frames: int) -> None:
        modes = {label_of(mode): mode for mode in self._material.modes}
        top, bottom = depths_mm
        most = 60.0
        wide: dict[str, Any] = {"width": _SIDE_PX - 20}
        self._mode = pn.widgets.Select(name="mode", options=modes, value=self.shown.mode, **wide)
        self._other = pn.widgets.Select(name="compared with", options={_ALONE: None, **modes}, **wide)
        self._style = pn.widgets.RadioButtonGroup(
            options={"side by side": False, "difference": True}, value=False, **wide
        )
        self._frame = pn.widgets.IntSlider(name="frame", start=0, end=max(frames - 1, 1), **wide)
        self._lateral = pn.widgets.FloatSlider(
            name="lateral / mm", start=0.0, end=width_mm, step=0.05, **wide
        )
        self._depth = pn.widgets.FloatSlider(name="depth / mm", start=top, end=bottom, step=0.05, **wide)
        self._shift = pn.widgets.FloatSlider(name="shift / mm", start=-most, end=most, step=0.05, **wide)
        self._turn = pn.widgets.FloatSlider(name="turn / °", start=-180.0, end=180.0, step=0.5, **wide)
        self._tilt = pn.widgets.FloatSlider(name="tilt / °", start=-90.0, end=90.0, step=0.5, **wide)
        self._status = pn.pane.Str("")
        for widget, name in (
            (self._mode, "mode"), (self._other, "other"), (self._style, "is_difference"),
            (self._frame, "frame"), (self._lateral, "lateral_mm"), (self._depth, "depth_mm"),
        ):  # fmt: skip
            widget.param.watch(partial(self._widget_changed, name), "value")
        for widget, name in (
            (self._shift, "shift_mm"), (self._turn, "turn_deg"), (self._tilt, "tilt_deg")
        ):  # fmt: skip
            widget.param.watch(partial(self._plane_changed, name), "value")

    def _widget_changed(self, name: str, event: Any) -> None:
        if not self._setting:
            self.change(**{name: event.new})

    def _plane_changed(self, name: str, event: Any) -> None:
        if not self._setting:
            self.change(plane=replace(self.shown.plane, **{name: event.new}))

    def _set_widgets(self) -> None:
        shown, plane = self.shown, self.shown.plane
        self._setting = True
        self._mode.value, self._other.value, self._style.value = shown.mode, shown.other, shown.is_difference
        self._frame.value, self._lateral.value, self._depth.value = shown.frame, shown.lateral_mm, shown.depth_mm
        self._shift.value, self._turn.value, self._tilt.value = plane.shift_mm, plane.turn_deg, plane.tilt_deg
        self._setting = False

    def _pick(self, mode: str, point_mm: FloatArray) -> None:
        print(mode, np.round(point_mm, 3))

    def _told(self, name: Name, key: tuple[object, ...], found: CutPicture | str, is_fine: bool) -> None:
        """Take a cut from another thread."""

        def show() -> None:
            if key != self.shown.key(name):
                return
            with pn.io.hold(self._document):
                if isinstance(found, str):
                    self._cuts.show_none(name, found)
                else:
                    self._cuts.show_cut(name, found, is_fine)

        self._later(show)

    def _tell_progress(self, mode: str, share: float) -> None:
        words = "" if share == 1.0 else f"making voxels of {label_of(mode)}: {100 * share:.0f} %"
        self._later(lambda: setattr(self._status, "object", words))

    def _later(self, act: Callable[[], None], after_ms: int = 0) -> None:
        """Do something in the viewer's own turn; at once where there is no server, as in notebooks."""
        if self._document is None or self._document.session_context is None:
            act()
        elif after_ms:
            self._document.add_timeout_callback(act, after_ms)
        else:
            self._document.add_next_tick_callback(act)
