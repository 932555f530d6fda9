"""The plots of a sweep: the image with its patches in mm; flags, doubts and sensors over the time."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from bokeh.models import (
    ColumnDataSource,
    FactorRange,
    HoverTool,
    LinearColorMapper,
    PrintfTickFormatter,
    Range1d,
)
from bokeh.models.annotations import ColorBar, Span
from bokeh.palettes import Viridis256
from bokeh.plotting import figure
from scipy.spatial.transform import RigidTransform

import speckle3d as s3
from speckle3d.app.plots import ImagePlot, time_plot
from speckle3d.core.arrays import AnyArray, FloatArray, IntArray
from speckle3d.core.errors import Doubt
from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import FramePairs
from speckle3d.matching.quality import FrameFlag

PatchValues = dict[str, AnyArray]

NEIGHBOURS = 8
"""Frames before and after with which a frame can be compared."""

REASONS = {
    FrameFlag.FROZEN: "frozen: bit for bit the frame before, which the recorder repeated",
    FrameFlag.SATURATED: "saturated: so many samples are clipped that correlations cannot be trusted",
    FrameFlag.LIFTED: "lifted: no contact: noise alone",
    FrameFlag.NO_SPECKLE: "no speckle: too few patches hold speckle",
    FrameFlag.UNMATCHED: "unmatched: no earlier frame correlates with it: too fast, or frames lost",
}
FLAG_COLOUR, _DOUBT_COLOUR, _OUTLIER_COLOUR = "#d55e00", "#7b3fa0", "#ff4d4d"
_LINES = ("#0072b2", "#d55e00", "#009e73")
"""Of three quantities, told apart by the colour-blind (Okabe and Ito)."""
_COLUMNS = "x", "y", "angle", "distance", "sigma"
_PATCHES = *_COLUMNS, "value", "line", "cross"
_ROW_PX, _LEFT_PX = 16, 108


class PatchPlot(ImagePlot):
    """The image of one frame, axes in mm, and its patches.

    Parameters
    ----------
    patch_mm : tuple of (float, float)
        Width and height of a patch.
    """

    def __init__(self, patch_mm: tuple[float, float]) -> None:
        super().__init__("lateral / mm")
        self._patches = ColumnDataSource({name: [] for name in _PATCHES})
        self._colours = LinearColorMapper(palette=Viridis256, low=0.0, nan_color="rgba(0,0,0,0)")
        width, height = patch_mm
        patches = self.plot.rect(
            "x",
            "y",
            width=width,
            height=height,
            angle="angle",
            source=self._patches,
            line_color="line",
            fill_color={"field": "value", "transform": self._colours},
            fill_alpha=0.5,
        )
        self.plot.scatter(
            "x", "y", marker="x", size="cross", line_color=_OUTLIER_COLOUR, source=self._patches
        )
        tips = [
            ("distance", "@distance{0.000} mm"),
            ("standard deviation of the distance", "@sigma{0.000} mm"),
        ]
        self.plot.add_tools(HoverTool(renderers=[patches], tooltips=tips))
        ticks = PrintfTickFormatter(format="%.2f mm")
        self._bar = ColorBar(color_mapper=self._colours, formatter=ticks, width=10, padding=4, visible=False)
        self.plot.add_layout(self._bar, "right")

    def colour(self, patches: PatchValues | None, by: str, most: float) -> None:
        """Draw patches coloured by a quantity from zero to `most`; none where there are none."""
        self._bar.visible = patches is not None
        if patches is None:
            self._patches.data = {name: [] for name in _PATCHES}
            return
        outlier = np.isfinite(patches["distance"]) & ~patches["inliers"]
        self._colours.high = most
        self._patches.data = {name: patches[name] for name in _COLUMNS} | {
            "value": patches[by],
            "line": np.where(outlier, _OUTLIER_COLOUR, "#ffffff"),
            "cross": np.where(outlier, 16, 0),
        }


class TimePlots:
    """Plots over the images' clock with a cursor at the frame; a click on any jumps there.

    Parameters
    ----------
    sweep : Sweep
    jump : callable
        Called with the frame that is clicked.
    flags : ndarray of int, or None
        Frames are marked, a row for every kind of flag there is.
    doubts : sequence of Doubt
        As are stretches in doubt.
    """

    def __init__(
        self, sweep: s3.Sweep, jump: Callable[[int], None], flags: IntArray | None, doubts: Sequence[Doubt]
    ) -> None:
        self._time_s, self._jump = sweep.frame_time_s, jump
        self.interval_s = float(np.median(np.diff(self._time_s))) if len(sweep) > 1 else 0.04
        self._half_s = self.interval_s / 2
        self._range = Range1d(self._time_s[0] - self.interval_s, self._time_s[-1] + self.interval_s)
        self.cursor = Span(dimension="height", line_color="#cc0000", line_width=1.5)
        marks = [
            (reason.partition(":")[0], frame, frame, FLAG_COLOUR, reason)
            for flag, reason in REASONS.items()
            for frame in ([] if flags is None else np.flatnonzero(flags & int(flag)).tolist())
        ]
        marks += [
            (doubt.about, *ends, _DOUBT_COLOUR, str(doubt)) for doubt in doubts for ends in doubt.frames
        ]
        rows = list(dict.fromkeys(row for row, *_ in marks))
        data = {
            "row": [row for row, *_ in marks],
            "left": [self._time_s[first] - self._half_s for _, first, *_ in marks],
            "right": [self._time_s[last] + self._half_s for _, _, last, *_ in marks],
            "colour": [mark[3] for mark in marks],
            "words": [mark[4] for mark in marks],
        }
        self.marks = self._plot(
            "",
            y_range=FactorRange(factors=rows[::-1] or ["no frame"]),
            height=_ROW_PX * max(len(rows), 1) + 6,
            visible=bool(rows),
        )
        bars = self.marks.hbar("row", left="left", right="right", height=0.7, color="colour", source=data)
        self.marks.add_tools(HoverTool(renderers=[bars], tooltips="@words"))
        self.marks.xaxis.visible = False

    def move(self, frame: int) -> None:
        """Put the cursor at a frame."""
        self.cursor.location = float(self._time_s[frame])

    def stream(self, label: str, parts: Sequence[str], time_s: FloatArray, values: FloatArray) -> figure:
        """Plot of quantities of a sensor, shape (m, 3)."""
        plot = self._plot(label, height=145)
        plot.xaxis.axis_label = "time / s"
        for part, colour, column in zip(parts, _LINES, values.T, strict=True):
            plot.line(time_s, column, color=colour, line_width=1.4, legend_label=part)
        plot.add_layout(plot.legend[0], "right")
        plot.legend.update(padding=2, spacing=0, margin=2, label_text_font_size="11px", border_line_alpha=0.0)
        return plot

    def _plot(self, label: str, **look: Any) -> figure:
        edges = {"min_border_left": _LEFT_PX, "min_border_top": 3, "min_border_bottom": 3}
        size = {"sizing_mode": "stretch_width", **edges, **look}
        return time_plot(label, self._range, self.cursor, self._go, **size)

    def _go(self, time_s: float) -> None:
        self._jump(int(np.argmin(np.abs(self._time_s - time_s))))


def patch_values(pairs: FramePairs, grid: ImageGrid, frame: int, partner: int) -> PatchValues | None:
    """Patches of a frame by its pair with another, by name; None for a pair that was not reconstructed.

    Returns
    -------
    dict of str to ndarray, or None
        Where the patches lie in this frame (``x``, ``y``, mm) and by which ``angle``, rad, they are turned
        there, a fan's vectors included; their ``distance`` and its ``sigma``, mm, NaN where there is none;
        ``inliers``, those that the plane of the pair rests on; ``elevation``, how far the image's centre is
        from the other frame along its elevational axis, mm, and standard deviation.
    """
    first, second = sorted((frame, partner))
    rows = np.flatnonzero((pairs.first == first) & (pairs.second == second))
    if not rows.size:
        return None
    row = int(rows[0])
    first_from_second = RigidTransform.from_matrix(pairs.first_from_second[row])
    # Patches tile the earlier frame.
    centre_mm = np.column_stack([pairs.patch_centre_mm, np.zeros(len(pairs.patch_centre_mm))])
    angle = -grid.angle_rad(grid.sample_at(pairs.patch_centre_mm)[:, 0])
    if frame == second:
        second_from_first = first_from_second.inv()
        centre_mm = second_from_first.apply(centre_mm)
        angle = angle + second_from_first.rotation.as_euler("zyx")[0]
    elevation = abs(first_from_second.apply(grid.centre_mm)[2]), pairs.covariance[row, 2, 2] ** 0.5
    return {
        "x": centre_mm[:, 0],
        "y": centre_mm[:, 1],
        "angle": angle,
        "distance": pairs.distance_mm[row].astype(float),
        "sigma": pairs.sigma_mm[row].astype(float),
        "inliers": pairs.used[row],
        "elevation": np.array(elevation),
    }
