"""The four cuts of a viewer: what the mouse does in one is seen in the others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import panel as pn
from bokeh.models.annotations import Span
from panel.viewable import Viewable

from speckle3d.app.reconstruction.cuts.cut_plot import (
    DEPTH,
    FRAME,
    FREE,
    LATERAL,
    Box,
    CutPlot,
    Handle,
    grey,
    laid_over,
)
from speckle3d.app.reconstruction.cuts.free_plane import SweepAxes
from speckle3d.app.reconstruction.cuts.material import Material
from speckle3d.app.reconstruction.cuts.shown import LEVELS_DB, NAMES, Name, Shown
from speckle3d.core.arrays import FloatArray
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.study.figures import label_of
from speckle3d.study.reslices.cuts import CutPicture
from speckle3d.study.reslices.places import AnyCut, frame_lines

_ALONE_PX, _BESIDE_PX = (285, 262), (196, 262)
"""Width and height of a cut's picture, of one mode and of two side by side."""
_ARM = 0.32
"""Of the box's smaller side: from the handle that moves the free plane to the one that turns it."""
_NEAR_MM = 0.3
"""A picked point is drawn in cuts as near as this."""
TITLES: dict[Name, str] = {
    "along": "along the sweep",
    "frame": "across the sweep",
    "depth": "parallel to the skin",
    "free": "free plane",
}

ORTHOGONAL: tuple[Name, ...] = ("along", "frame", "depth")


class CutsView:
    """Plots of the cuts of one mode or two.

    Parameters
    ----------
    material : Material
    changed : callable
        Called with what the mouse changed of `Shown`, by name.
    picked : callable
        Called with the mode and the point of its world that was clicked on, shape (3,), mm.
    """

    def __init__(
        self,
        material: Material,
        changed: Callable[..., None],
        picked: Callable[[str, FloatArray], None],
    ) -> None:
        self._material, self._changed, self._picked = material, changed, picked
        self.shown = Shown(material.modes[0])
        self.plots = {name: CutPlot(f"cut-{name}", _ALONE_PX, self._picker(name, 0)) for name in NAMES}
        self._others = {name: CutPlot(f"other-{name}", _BESIDE_PX, self._picker(name, 1)) for name in NAMES}
        self._cuts: dict[tuple[Name, str], AnyCut] = {}
        self._points: dict[str, FloatArray] = {}
        self._spans = self._add_spans()
        self._movers: dict[Name, Handle] = {}
        self._turners: dict[Name, Handle] = {}
        for name in ORTHOGONAL:
            self._movers[name] = Handle(self.plots[name], FREE, False, self._mover(name))
            self._turners[name] = Handle(self.plots[name], FREE, True, self._turner(name))
        self._placing = False
        self._frame_lines: dict[Name, tuple[tuple[int, int], FloatArray]] = {}

    def layout(self) -> Viewable:
        """The plots in two rows; those of a second mode are hidden while there is none."""

        def cell(name: Name) -> Viewable:
            return pn.Row(pn.pane.Bokeh(self.plots[name].plot), pn.pane.Bokeh(self._others[name].plot))

        return pn.Column(*(pn.Row(*map(cell, NAMES[row : row + 2])) for row in (0, 2)))

    def draw(self) -> None:
        """Draw lines where they are now; cuts follow by `show_cut`."""
        self._placing = True
        for (_, what), span in self._spans.items():
            span.location = self.shown.lateral_mm if what == "lateral_mm" else self.shown.depth_mm
        self._placing = False
        for name in NAMES:
            self._draw_lines(name)

    def draw_handles(self) -> bool:
        """Put handles where the lines are, but for what the mouse holds; tell whether it holds one."""
        for name in ORTHOGONAL:
            self._place_handles(name, self._line_of_plane(name))
        return any(each.is_held for each in (*self._movers.values(), *self._turners.values()))

    def show_cut(self, name: Name, picture: CutPicture, is_fine: bool) -> None:
        """Show a cut of the modes."""
        mode, other = self.shown.mode, self.shown.other
        levels = picture.levels or LEVELS_DB
        for each, drawn in picture.cuts.items():
            self._cuts[name, each] = drawn.cut
        main = picture.cuts[mode]
        colours = grey(main.image, levels)
        if other and self.shown.is_difference:
            colours = laid_over(picture.cuts[other].image, main.image, levels)
        self.plots[name].show(colours, main.cut.extent_mm)
        said = f"free {picture.place}" if name == "free" else picture.place
        if other and not self.shown.is_difference:
            where = "free plane" if name == "free" else picture.place.split(", seen")[0]
            said = f"{label_of(mode)}: {where}"
        said = said if is_fine else f"{said} (voxels)"
        self.plots[name].name_axes(said, picture.axes)
        if other and not self.shown.is_difference:
            drawn = picture.cuts[other]
            self._others[name].show(grey(drawn.image, levels), drawn.cut.extent_mm)
            self._others[name].name_axes(label_of(other), picture.axes)
        self._fit(name, main.cut)
        self._draw_lines(name)
        if is_fine:
            self.draw_handles()
        self._draw_points(name)

    def show_none(self, name: Name, why: str) -> None:
        """Say why there is no cut."""
        self.plots[name].title(why.split(";")[0])
        for plot in (self.plots[name], self._others[name]):
            plot.show(np.zeros((1, 1), np.uint32), (0.0, 1e-6, 1e-6, 0.0))

    @property
    def planes(self) -> dict[Name, ReslicePlane]:
        """Where the cuts of the first mode are, as far as they are made."""
        found = {name: self._cuts.get((name, self.shown.mode)) for name in NAMES}
        return {name: cut for name, cut in found.items() if isinstance(cut, ReslicePlane)}

    def show_points(self, points: dict[str, FloatArray]) -> None:
        """Draw picked points, shape (k, 3) by mode, in the cuts that they lie in."""
        self._points = points
        for name in NAMES:
            self._draw_points(name)

    def lay_out_for(self, is_beside: bool) -> None:
        """Make room for the plots of a second mode, or take it away."""
        for name in NAMES:
            self._others[name].plot.visible = is_beside
            self.plots[name].resize(_BESIDE_PX if is_beside else _ALONE_PX)
            for plot in (self.plots[name], self._others[name]):
                plot.fit(plot.box)

    def _fit(self, name: Name, cut: AnyCut) -> None:
        box = self._span_of_free() if name == "free" else Box(*cut.extent_mm)
        for plot in (self.plots[name], self._others[name]):
            if plot.box != box:
                plot.fit(box)

    def _span_of_free(self) -> Box:
        """Box that holds what any free plane shows: the scale stays as it is turned."""
        grid = self._material.grid
        path = self._material.opened(self.shown.mode).poses[self.shown.mode]
        length = float(np.linalg.norm(np.ptp(path.apply(grid.centre_mm), axis=0)))
        tall = grid.depth_mm - grid.first_sample_depth_mm
        x, y = np.hypot(grid.width_mm, length) / 2, np.hypot(tall, length) / 2
        return Box(-x, x, y, -y)

    def _draw_lines(self, name: Name) -> None:
        lines = self._line_of_frame(name)
        ends = self._line_of_plane(name)
        self.plots[name].show_lines([*lines, *([] if ends is None else [(ends, FREE)])])

    def _line_of_frame(self, name: Name) -> list[tuple[FloatArray, str]]:
        cut = self._cuts.get((name, self.shown.mode))
        if name == "frame" or cut is None:
            return []
        key = (self.shown.frame, id(cut))
        if name not in self._frame_lines or self._frame_lines[name][0] != key:
            poses = self._material.opened(self.shown.mode).poses[self.shown.mode]
            one = poses[self.shown.frame : self.shown.frame + 1]
            self._frame_lines[name] = key, frame_lines(cut, self._material.grid, one)[0]
        return [(self._frame_lines[name][1], FRAME)]

    def _line_of_plane(self, name: Name) -> FloatArray | None:
        """Ends of the free plane's line in a cut, shape (2, 2); None where it has none."""
        cut = self._cuts.get((name, self.shown.mode))
        if name == "free" or not isinstance(cut, ReslicePlane):
            return None
        found = self._axes.line_in(self.shown.plane, cut)
        return None if found is None else self.plots[name].box.line(*found)

    def _place_handles(self, name: Name, ends: FloatArray | None) -> None:
        mover, turner = self._movers[name], self._turners[name]
        if ends is None:
            mover.place(None)
            turner.place(None)
            return
        along = ends[1] - ends[0]
        size = float(np.linalg.norm(along))
        along = along / max(size, 1e-9)
        # Where it was along the line, if that is still in sight.
        wished = (mover.at if mover.box.visible else ends.mean(axis=0)) - ends[0]
        at = ends[0] + along * np.clip(wished @ along, 0.0, size)
        box = self.plots[name].box
        reach = _ARM * min(abs(box.right - box.left), abs(box.bottom - box.top))
        # What the mouse holds stays where the mouse is.
        if not mover.is_held and not turner.is_held:
            mover.place(at)
        if not turner.is_held:
            turner.place(mover.at + along * reach)

    def _mover(self, name: Name) -> Callable[[FloatArray, FloatArray], None]:
        def moved(old: FloatArray, new: FloatArray) -> None:
            self._changed(plane=self._axes.moved(self.shown.plane, self._plane(name), old, new))

        return moved

    def _turner(self, name: Name) -> Callable[[FloatArray, FloatArray], None]:
        def turned(old: FloatArray, new: FloatArray) -> None:
            pivot = self._movers[name].at
            (x, y), (u, v) = old - pivot, new - pivot
            angle = float(np.arctan2(x * v - y * u, x * u + y * v))
            self._changed(plane=self._axes.turned(self.shown.plane, self._plane(name), pivot, angle))

        return turned

    def _plane(self, name: Name) -> ReslicePlane:
        cut = self._cuts[name, self.shown.mode]
        assert isinstance(cut, ReslicePlane)  # only curves give another kind
        return cut

    @property
    def _axes(self) -> SweepAxes:
        return self._material.axes(self.shown.mode)

    def _add_spans(self) -> dict[tuple[Name, str], Span]:
        def moved(what: str) -> Callable[[float], None]:
            def tell(value: float) -> None:
                if not self._placing:
                    self._changed(**{what: value})

            return tell

        wanted: list[tuple[Name, str, Literal["width", "height"], str]] = [
            ("along", "depth_mm", "width", DEPTH),
            ("frame", "depth_mm", "width", DEPTH),
            ("frame", "lateral_mm", "height", LATERAL),
            ("depth", "lateral_mm", "width", LATERAL),
        ]
        return {
            (name, what): self.plots[name].add_span(dimension, colour, moved(what))
            for name, what, dimension, colour in wanted
        }

    def _picker(self, name: Name, which: int) -> Callable[[float, float], None]:
        def picked(x: float, y: float) -> None:
            modes = self.shown.modes
            cut = self._cuts.get((name, modes[min(which, len(modes) - 1)]))
            if cut is not None:
                self._picked(modes[min(which, len(modes) - 1)], cut.world_from_mm(x, y))

        return picked

    def _draw_points(self, name: Name) -> None:
        for plot, mode in zip((self.plots[name], self._others[name]), self.shown.modes, strict=False):
            cut, points = self._cuts.get((name, mode)), self._points.get(mode, np.empty((0, 3)))
            if not isinstance(cut, ReslicePlane):
                continue
            there = cut.world_from_plane.inv().apply(points) if len(points) else points
            near = np.abs(there[:, 2]) < _NEAR_MM
            xy = there[:, :2] + np.array(cut.first_mm)
            plot.show_points(np.where(near[:, None], xy, np.nan), [str(k + 1) for k in range(len(points))])
