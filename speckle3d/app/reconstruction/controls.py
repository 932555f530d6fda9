"""Widgets that choose the modes and say where the cuts are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import panel as pn
from panel.viewable import Viewable

from speckle3d.app.reconstruction.cuts.cut_plot import DEPTH, FRAME, FREE, LATERAL
from speckle3d.app.reconstruction.cuts.free_plane import FreePlane
from speckle3d.app.reconstruction.cuts.material import Material
from speckle3d.app.reconstruction.cuts.shown import Shown
from speckle3d.study.figures import label_of

_ALONE = ""
_PRESETS = {"across": FreePlane(), "along": FreePlane(0.0, 90.0, 0.0), "skin": FreePlane(0.0, 0.0, 90.0)}


class Controls:
    """Widgets of what is shown.

    Parameters
    ----------
    material : Material
    width_px : int
    changed : callable
        Called with what a person changed of `Shown`, by name.
    """

    def __init__(self, material: Material, width_px: int, changed: Callable[..., None]) -> None:
        self._changed, self._setting, self.shown = changed, False, Shown(material.modes[0])
        grid, poses = material.grid, material.opened(material.modes[0]).poses[material.modes[0]]
        modes = {label_of(mode): mode for mode in material.modes}
        wide: dict[str, Any] = {"width": width_px, "margin": (2, 5)}
        top, bottom = grid.first_sample_depth_mm, grid.depth_mm
        size = [grid.width_mm, bottom - top, *np.ptp(poses.apply(grid.centre_mm), axis=0)]
        most = float(np.ceil(np.linalg.norm(size) / 2))
        self.mode = pn.widgets.Select(name="mode", options=modes, value=material.modes[0], **wide)
        self.other = pn.widgets.Select(name="compared with", options={"(nothing)": _ALONE, **modes}, **wide)
        self.style = pn.widgets.RadioButtonGroup(
            options={"side by side": False, "difference": True}, value=False, **wide
        )
        self.frame = pn.widgets.IntSlider(
            name="frame", start=0, end=max(len(poses) - 1, 1), **_bar(FRAME, wide)
        )
        self.lateral = _slider("lateral / mm", (0.0, grid.width_mm), 0.05, LATERAL, wide)
        self.depth = _slider("depth / mm", (top, bottom), 0.05, DEPTH, wide)
        self.shift = _slider("shift along its normal / mm", (-most, most), 0.05, FREE, wide)
        self.turn = _slider("turn about the depth axis / °", (-180.0, 180.0), 0.5, FREE, wide)
        self.tilt = _slider("tilt / °", (-90.0, 90.0), 0.5, FREE, wide)
        self.presets = pn.Row(margin=0)
        for name, plane in _PRESETS.items():
            button = pn.widgets.Button(name=name, width=(width_px - 20) // 3, margin=(2, 5))
            button.on_click(partial(self._set_plane, plane))
            self.presets.append(button)
        for widget, name in (
            (self.mode, "mode"), (self.other, "other"), (self.style, "is_difference"),
            (self.frame, "frame"), (self.lateral, "lateral_mm"), (self.depth, "depth_mm"),
        ):  # fmt: skip
            widget.param.watch(partial(self._tell, name), "value")
        for widget, name in ((self.shift, "shift_mm"), (self.turn, "turn_deg"), (self.tilt, "tilt_deg")):
            widget.param.watch(partial(self._tell_plane, name), "value")

    def layout(self) -> Viewable:
        """The widgets below each other."""
        words = pn.pane.HTML(
            f"<b style='color:{FREE}'>Free plane</b>: drag ■ to move it, ● to turn it", margin=(8, 5, 0, 5)
        )
        return pn.Column(
            self.mode, self.other, self.style, self.frame, self.lateral, self.depth, words,
            self.shift, self.turn, self.tilt, self.presets, margin=0,
        )  # fmt: skip

    def show(self, shown: Shown) -> None:
        """Set all widgets to what is shown."""
        plane = shown.plane
        self.shown, self._setting = shown, True
        self.mode.value, self.other.value = shown.mode, shown.other or _ALONE
        self.style.value = shown.is_difference
        self.style.disabled = shown.other is None
        self.frame.value, self.lateral.value, self.depth.value = shown.frame, shown.lateral_mm, shown.depth_mm
        self.shift.value = round(plane.shift_mm, 2)
        self.turn.value, self.tilt.value = round(plane.turn_deg, 1), round(plane.tilt_deg, 1)
        self._setting = False

    def _tell(self, name: str, event: Any) -> None:
        if not self._setting:
            self._changed(**{name: None if name == "other" and event.new == _ALONE else event.new})

    def _tell_plane(self, name: str, event: Any) -> None:
        if not self._setting:
            self._changed(plane=replace(self.shown.plane, **{name: event.new}))

    def _set_plane(self, plane: FreePlane, _: object) -> None:
        self._changed(plane=plane)


def _slider(
    name: str, ends: tuple[float, float], step: float, colour: str, look: dict[str, Any]
) -> pn.widgets.FloatSlider:
    return pn.widgets.FloatSlider(name=name, start=ends[0], end=ends[1], step=step, **_bar(colour, look))


def _bar(colour: str, look: dict[str, Any]) -> dict[str, Any]:
    return {**look, "bar_color": colour}
