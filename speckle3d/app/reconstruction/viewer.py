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
from tornado.ioloop import IOLoop

from speckle3d.app.folder import Folder
from speckle3d.app.reconstruction.bands import QUANTITIES, BandsPlot
from speckle3d.app.reconstruction.controls import Controls
from speckle3d.app.reconstruction.cuts.cuts_view import CutsView
from speckle3d.app.reconstruction.cuts.cutter import Cutter
from speckle3d.app.reconstruction.cuts.free_plane import FreePlane
from speckle3d.app.reconstruction.cuts.material import Material
from speckle3d.app.reconstruction.cuts.shown import Name, Shown
from speckle3d.app.reconstruction.measure_view import MeasureView
from speckle3d.app.reconstruction.saving import Saving
from speckle3d.app.reconstruction.space import figure_space
from speckle3d.core.arrays import FloatArray
from speckle3d.study.figures import label_of
from speckle3d.study.reslices.cuts import CutPicture

_SIDE_PX, _SPACE_PX = 270, (350, 350)
_BANDS_PX = (350, 225)
_SOON_MS, _LATER_MS, _REST_MS = 15, 150, 400
"""After which lines and handles, numbers, and what is seen in space follow a change."""
_MEASURE_TAB = 1


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
        self._material = material
        self._document = pn.state.curdoc
        if self._is_served:
            self._loop = IOLoop.current()
        grid, frames = material.grid, len(material.reconstruction.frame_time_s)
        middle = (grid.first_sample_depth_mm + grid.depth_mm) / 2
        self.shown = Shown(
            material.modes[0], None, False, frames // 2, round(grid.width_mm / 2, 2), round(middle, 2),
            FreePlane(0.0, 45.0, 0.0),
        )  # fmt: skip
        self._due: set[Callable[[], None]] = set()
        self._shares: dict[str, float] = {}
        self._is_gone = False
        if self._document is not None:
            self._document.on_session_destroyed(self._leave)
        self._controls = Controls(material, _SIDE_PX - 10, self.change)
        self._cuts = CutsView(material, self.change, self._pick)
        self._cuts.shown = self.shown
        self._measure = MeasureView(
            material.reconstruction, folder.opened.name, _SIDE_PX - 10, self._draw_points
        )
        self._saving = Saving(material, folder, sweep_file, _SIDE_PX - 10)
        self._bands = BandsPlot(material, _BANDS_PX)
        self._space = pn.pane.Plotly(None, width=_SPACE_PX[0], height=_SPACE_PX[1], margin=0)
        self._status = pn.pane.HTML("", width=_SIDE_PX - 10, min_height=20, margin=(0, 5))
        self._cutter = Cutter(material, self._told)

    def view(self) -> Viewable:
        """Lay everything out and begin."""
        pn.extension("plotly")
        quantity = pn.widgets.RadioButtonGroup(options=list(QUANTITIES), width=_SPACE_PX[0] - 20)
        quantity.param.watch(lambda event: self._bands.show(event.new), "value")
        words = pn.pane.HTML(
            "Centre of the image, all modes from the first frame's place; shaded: 95 %. "
            "Click a name to hide it.", margin=(0, 5), width=_SPACE_PX[0] - 10,
        )  # fmt: skip
        self._aside = pn.Column(words, self._space, quantity, pn.pane.Bokeh(self._bands.plot), margin=0)
        self._tabs = pn.Tabs(
            ("cuts", self._controls.layout()),
            ("measure", self._measure.layout()),
            ("save", self._saving.layout()),
            width=_SIDE_PX,
        )
        self._begin()
        self._draw()
        self._draw_numbers()
        self._draw_space()
        self._cutter.ask(self.shown)
        side = pn.Column(self._tabs, self._status, width=_SIDE_PX, margin=(0, 5))
        return pn.Row(side, self._aside, self._cuts.layout(), margin=0)

    def change(self, **changes: Any) -> None:
        """Show something else; what is drawn follows soon, so that many changes are drawn once."""
        before, self.shown = self.shown, replace(self.shown, **changes)
        if self.shown.other == self.shown.mode:
            self.shown = replace(self.shown, other=None)
        self._cuts.shown = self._controls.shown = self.shown
        if self.shown != before:
            if self.shown.modes != before.modes or self.shown.is_difference != before.is_difference:
                self._begin()
            self._cutter.ask(self.shown)
        self._once(self._draw, _SOON_MS)

    def _leave(self, _: object) -> None:
        """Have nothing done for someone who left."""
        self._is_gone = True

    def _begin(self) -> None:
        """Make room for the modes, and have their voxels made."""
        beside = self.shown.other is not None and not self.shown.is_difference
        self._cuts.lay_out_for(beside)
        self._aside.visible = not beside
        self._status.object = self._colours()
        for mode in self.shown.modes:
            self._material.ask_for_voxels(mode, self._tell_progress)
        self._cutter.forget()

    def _draw(self) -> None:
        with pn.io.hold(self._document):
            self._cuts.draw()
        self._once(self._draw_numbers, _LATER_MS)
        self._once(self._draw_space, _REST_MS)

    def _draw_numbers(self) -> None:
        with pn.io.hold(self._document):
            is_held = self._cuts.draw_handles()
            self._controls.show(self.shown)
            self._bands.cursor.location = self.shown.frame
            self._saving.show(self.shown)
        if is_held and self._is_served:
            self._once(self._draw_numbers, _REST_MS)

    def _draw_space(self) -> None:
        planes = self._cuts.planes
        self._space.object = figure_space(self._material, self.shown.modes, self.shown.frame, planes)

    def _draw_points(self) -> None:
        self._cuts.show_points(
            {mode: np.array(each).reshape(-1, 3) for mode, each in self._measure.points.items()}
        )

    def _pick(self, mode: str, point_mm: FloatArray) -> None:
        self._tabs.active = _MEASURE_TAB
        self._measure.add(mode, point_mm)

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
            if is_fine:
                self._once(self._draw_space, _REST_MS)

        self._later(show)

    def _tell_progress(self, mode: str, share: float) -> None:
        # Turns may come in another order than they were asked for.
        self._shares[mode] = max(share, self._shares.get(mode, 0.0))
        self._later(self._say_progress)

    def _say_progress(self) -> None:
        making = [
            f"{label_of(mode)} {100 * share:.0f} %" for mode, share in self._shares.items() if share < 1.0
        ]
        self._status.object = f"making voxels: {', '.join(making)}" if making else self._colours()

    def _colours(self) -> str:
        """What the colours of a difference mean."""
        mode, other = self.shown.mode, self.shown.other
        if other is None or not self.shown.is_difference:
            return ""
        return (
            f"<b style='color:#c000c0'>magenta</b>: {label_of(other)} alone, "
            f"<b style='color:#008000'>green</b>: {label_of(mode)} alone, grey: both"
        )

    def _once(self, act: Callable[[], None], after_ms: int) -> None:
        """Do something a while later, once however often it is asked for until then."""
        if act in self._due:
            return
        self._due.add(act)

        def do() -> None:
            self._due.discard(act)
            act()

        self._later(do, after_ms)

    @property
    def _is_served(self) -> bool:
        """Whether there is a server with turns to wait for."""
        return self._document is not None and self._document.session_context is not None

    def _later(self, act: Callable[[], None], after_ms: int = 0) -> None:
        """Do something in the viewer's own turn; at once where there is no server, as in notebooks."""
        if self._is_gone:
            return
        if self._document is None or not self._is_served:
            act()
            return
        add: Callable[[], object]
        if after_ms:
            add = partial(self._document.add_timeout_callback, act, after_ms)
        else:
            add = partial(self._document.add_next_tick_callback, act)
        # Turns that another thread asks for while changes are held back would be lost.
        self._loop.add_callback(add)
