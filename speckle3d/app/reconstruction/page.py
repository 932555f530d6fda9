"""The reconstruction viewer: three cuts that a cross hair joins, trajectories in space, measurements."""

from dataclasses import replace
from functools import lru_cache
from html import escape
from typing import Any

import numpy as np
import panel as pn
import param
from panel.viewable import Viewable
from scipy.spatial.transform import RigidTransform

import speckle3d as s3
from speckle3d.app.look import batch_changes
from speckle3d.app.reconstruction.cut_plot import CutPlot
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import Speckle3DError
from speckle3d.report.figures import plot_outlines
from speckle3d.scoring.modes import length_claims
from speckle3d.scoring.references import find_reference
from speckle3d.study.figures import RANGE_DB, label_of
from speckle3d.study.pose_errors import PICKING, caution, how_measured
from speckle3d.study.posed import PosedSweep, SweepModes, at_modes
from speckle3d.study.reslices.cuts import cut_at_modes
from speckle3d.study.reslices.places import along_sweep, in_frame

KEPT_BYTES = 600_000_000
"""Of images that are kept; those of a longer sweep are made again when they are needed."""
_SIDE_PX = 250
_COLOURS = {"frame": "#ffd700", "lateral_mm": "#4fc3ff", "depth_mm": "#8de04f"}
"""Of sliders, and of the lines of the cross hair that they move."""
_CUTS = {
    "along": ("lateral_mm", ("frame", "depth_mm")),
    "frame": ("frame", ("lateral_mm", "depth_mm")),
    "depth": ("depth_mm", ("frame", "lateral_mm")),
}
"""Along the sweep, in a frame's plane, parallel to the skin: the slider that moves the cut, and those that
move the upright and the level line in it."""
_HELP = "Click in a cut: the cross hair, and with it the other cuts, go there."


class ReconstructionPage:
    """A reconstruction with the sweep it was made from.

    Parameters
    ----------
    reconstruction : Reconstruction
        Its pairs are not needed.
    sweep : Sweep
        Of the frames that were reconstructed; see `speckle3d.study.images.open_reconstruction`.
    mode : str
        The one that is shown first.
    """

    def __init__(self, reconstruction: s3.Reconstruction, sweep: s3.Sweep, mode: str = "image") -> None:
        self.reconstruction, self.mode = reconstruction, mode
        poses = reconstruction.poses[mode]
        self._sweep = PosedSweep(sweep, np.arange(len(sweep)), poses, mode, reconstruction)
        reference = find_reference(sweep)
        whole = reference is not None and reference.covered.all()
        self.modes = (*reconstruction.poses, *([reference.name] if reference and whole else []))
        source, _ = self._sweep.source(None, RANGE_DB)
        images = max(KEPT_BYTES // (4 * source.grid.vectors * source.grid.samples), 1)
        self.images = replace(source, images=lru_cache(images)(source.read))
        self.posed = lru_cache(self._at_modes)

    def view(self) -> Viewable:
        """Cuts, trajectories and what is measured in them."""
        return _Viewer(self).layout()

    def _at_modes(self, mode: str, overlay: str | None) -> SweepModes:
        return at_modes(self._sweep, [mode, *([overlay] if overlay else [])], mode)


class _Viewer(param.Parameterized):  # type: ignore[misc]
    """View of one viewer: modes, cross hair, and measured points."""

    mode = param.Selector(label="mode")
    overlay = param.Selector(label="compared with")
    frame = param.Integer(label="frame")
    lateral_mm = param.Number(label="lateral / mm", step=0.05)
    depth_mm = param.Number(label="depth / mm", step=0.05)
    points_mm = param.List([])

    def __init__(self, page: ReconstructionPage) -> None:
        self._page = page
        grid = self._grid = page.reconstruction.grid
        trust, poses = page.reconstruction.trust, page.reconstruction.poses
        claims = {} if trust is None else length_claims(poses, trust, grid.centre_mm)
        self._errors = {mode: f", +- {1.96 * sigma:.2f} mm (95 %)" for mode, (_, sigma) in claims.items()}
        modes = {label_of(mode): mode for mode in page.modes}
        self.param.mode.objects, self.param.overlay.objects = modes, {"(nothing)": "", **modes}
        self.param.frame.bounds = (0, len(page.reconstruction.frame_time_s) - 1)
        middle_mm = grid.extent_mm.mean(axis=0).round(2).tolist()
        self.param.lateral_mm.bounds, self.param.depth_mm.bounds = map(tuple, grid.extent_mm.T.tolist())
        super().__init__(
            mode=page.mode,
            overlay="",
            frame=self.param.frame.bounds[1] // 2,
            lateral_mm=middle_mm[0],
            depth_mm=middle_mm[1],
        )
        self._plots = {
            name: CutPlot(name, (_COLOURS[upright], _COLOURS[level]), self._go)
            for name, (_, (upright, level)) in _CUTS.items()
        }
        self._words, self._lengths = pn.pane.HTML(_HELP, width=_SIDE_PX), pn.pane.HTML("", width=_SIDE_PX)
        for name, (slider, _) in _CUTS.items():
            self.param.watch(lambda *_, name=name: self._cut(name), ["mode", "overlay", slider])
            self._cut(name)
        # After the cuts that it is drawn in.
        self.param.watch(self._draw_points, [*_COLOURS, "mode", "overlay", "points_mm"], precedence=1)
        self.param.watch(lambda _: setattr(self, "points_mm", []), "mode")
        self.param.watch(self._measure, "points_mm")
        self._draw_points()

    def layout(self) -> Viewable:
        """Sliders and measurements on the left, then two tall cuts, the third, and the trajectories."""
        looks: dict[str, Any] = {name: {"width": _SIDE_PX} for name in ("mode", "overlay")}
        looks |= {name: {"bar_color": colour} for name, colour in _COLOURS.items()}
        controls = pn.Param(self, parameters=[*looks], widgets=looks, show_name=False, width=_SIDE_PX)
        half = {"width": _SIDE_PX // 2 - 10}
        add = pn.widgets.Button(name="Add the point", button_type="primary", **half)
        remove = pn.widgets.Button(name="Remove the last", **half)
        add.on_click(self._add)
        remove.on_click(lambda _: setattr(self, "points_mm", self.points_mm[:-1]))
        calibrations = self._page.reconstruction.provenance.calibrations
        side = pn.Column(
            controls,
            self._lengths,
            pn.pane.HTML("<br>".join(f"calibration used: {escape(file.path)}" for file in calibrations)),
            pn.Row(add, remove, margin=0),
            self._words,
            width=_SIDE_PX + 40,
            scroll="y-auto",
            sizing_mode="stretch_height",
        )
        along, frame, depth = (
            pn.pane.Bokeh(plot.plot, sizing_mode="stretch_both") for plot in self._plots.values()
        )
        third = pn.Column(depth, self._trajectories(), sizing_mode="stretch_both")
        return pn.Row(side, along, frame, third, sizing_mode="stretch_both")

    def _trajectories(self) -> Viewable:
        """Outlines of the frames of all modes in space."""
        page = self._page
        poses = {mode: page.posed(mode, None).poses[mode] for mode in page.modes}
        outlines = plot_outlines(poses, self._grid)
        outlines.update_layout(
            height=None,
            margin={"l": 0, "r": 0, "t": 0, "b": 0},
            font_size=10,
            legend={"y": 1},
            scene_camera={"eye": {"x": 2.4, "y": -3.3, "z": 1.4}, "center": {"z": -0.05}},
            scene_xaxis_nticks=3,
            scene_yaxis_nticks=3,
        )
        return pn.pane.Plotly(outlines, sizing_mode="stretch_both")

    @property
    def _cross_mm(self) -> FloatArray:
        """Position of the cross hair in the world of the mode, shape (3,)."""
        return np.asarray(self._poses[self.frame].apply([self.lateral_mm, self.depth_mm, 0.0]))

    @property
    def _pair(self) -> tuple[str, str | None]:
        return self.mode, self.overlay if self.overlay not in ("", self.mode) else None

    @property
    def _poses(self) -> RigidTransform:
        return self._page.posed(*self._pair).poses[self.mode]

    @batch_changes
    def _cut(self, name: str) -> None:
        posed, plot = self._page.posed(*self._pair), self._plots[name]
        source, slider = self._page.images, _CUTS[name][0]
        try:
            cut: Any = in_frame if name == "frame" else along_sweep
            place = cut(posed, source.grid, **{slider: getattr(self, slider)})
            picture = cut_at_modes(posed, place, source)
        except Speckle3DError as error:
            plot.plot.title.text = str(error).split(";")[0]
            return
        plot.show_cut(picture, *self._pair)
        lengths = {
            mode: text.replace("\n", ", ") + self._errors.get(mode, "")
            for mode, text in picture.lengths.items()
        }
        words = "".join(f"length, {label_of(mode)}: {text}<br>" for mode, text in lengths.items())
        if self._pair[1]:
            words += "green: this mode alone, magenta: the other alone, grey: both"
        self._lengths.object = words

    def _go(self, point_mm: FloatArray) -> None:
        """Put the cross hair where the nearest frame has a point; beside the images, leave it."""
        posed = self._page.posed(*self._pair)
        inside = posed.poses[self.mode].inv().apply(point_mm)
        away = np.abs(inside[:, 2])
        away[self.frame] -= 1e-6  # of frames that lie as near, the one that is shown
        frame = int(np.argmin(away))
        lateral, depth, _ = np.round(inside[frame], 2).tolist()
        (left, top), (right, bottom) = self._grid.extent_mm
        if left <= lateral <= right and top <= depth <= bottom and away[frame] <= posed.reach_mm:
            self.param.update(frame=frame, lateral_mm=lateral, depth_mm=depth)

    @batch_changes
    def _draw_points(self, *_: Any) -> None:
        """Draw the cross hair and the points."""
        points = np.array(self.points_mm).reshape(-1, 3)
        for plot in self._plots.values():
            plot.show_points(self._cross_mm, points)

    def _add(self, *_: Any) -> None:
        """Measure from and to where the cross hair is."""
        self.points_mm = [*self.points_mm, self._cross_mm]

    def _measure(self, *_: Any) -> None:
        """Say what is between the points, as `speckle3d measure` does."""
        page, points = self._page, np.array(self.points_mm).reshape(-1, 3)
        lines = [
            f"{k + 1}: {', '.join(f'{value:.2f}' for value in point)} mm" for k, point in enumerate(points)
        ]
        if len(points) > 1:
            try:
                lines += [row.line for row in s3.measure(page.reconstruction, points, self.mode)]
                lines.append(how_measured(self.mode, PICKING * self._grid.vector_pitch_mm))
                lines += filter(None, [caution(page.reconstruction, self.mode)])
            except Speckle3DError as error:
                lines.append(str(error))
        self._words.object = "".join(f"<p style='margin:3px 0'>{escape(line)}</p>" for line in lines) or _HELP
