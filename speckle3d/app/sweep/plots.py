"""The plots of a sweep: the image with its patches in mm, and what was found and sensed over the time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from bokeh.events import Tap
from bokeh.models import ColumnDataSource, DataRange1d, FactorRange, HoverTool, LinearColorMapper, Range1d
from bokeh.models.annotations import ColorBar, Span
from bokeh.palettes import Greys256, Viridis256
from bokeh.plotting import figure

from speckle3d.app.sweep.findings import NAMES
from speckle3d.app.sweep.pairs import PatchValues
from speckle3d.core.arrays import ByteArray, FloatArray, IntArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import Sweep

FLAGGED, DOUBTED = "#d55e00", "#7b3fa0"
_REJECTED = "#ff4d4d"
_OPACITY = 0.5
_LINES = ("#0072b2", "#d55e00", "#009e73")
"""Of three quantities, told apart by the colour-blind (Okabe and Ito)."""
_UNITS = {"distance": "mm", "sigma": "mm", "correlation": ""}
_PATCHES = "x", "y", "angle", "value", "alpha", "line", "cross", "state", "distance", "sigma", "correlation"
_ROW_PX, _LEFT_PX = 16, 108


class ImagePlot:
    """The image of one frame, axes in mm, and its patches.

    Parameters
    ----------
    grid : ImageGrid
        Of the image.
    patch_mm : tuple of (float, float)
        Width and height of a patch.
    """

    def __init__(self, grid: ImageGrid, patch_mm: tuple[float, float]) -> None:
        self.levels = LinearColorMapper(palette=Greys256, low=0.0, high=255.0)
        self._image = ColumnDataSource({"image": []}, name="sweep image")
        self._patches = ColumnDataSource({name: [] for name in _PATCHES})
        self._colours = LinearColorMapper(palette=Viridis256, low=0.0, nan_color="rgba(0,0,0,0)")
        self.plot = figure(
            x_axis_label="lateral / mm",
            y_axis_label="depth / mm",
            match_aspect=True,
            sizing_mode="stretch_both",
            x_range=DataRange1d(),
            y_range=DataRange1d(flipped=True),
            tools="pan,wheel_zoom,box_zoom,reset,save",
            active_scroll="wheel_zoom",
        )
        self.plot.toolbar.logo = None
        self.plot.grid.visible = False
        self.plot.axis.axis_label_text_font_style = "normal"
        image = self.plot.image(
            "image",
            x=-grid.vector_pitch_mm / 2,
            y=grid.first_sample_depth_mm - grid.sample_spacing_mm / 2,
            dw=grid.vectors * grid.vector_pitch_mm,
            dh=grid.samples * grid.sample_spacing_mm,
            source=self._image,
            color_mapper=self.levels,
        )
        # Patches that lie elsewhere in every frame must not move it.
        self.plot.x_range.renderers = self.plot.y_range.renderers = [image]
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
            fill_alpha="alpha",
        )
        self.plot.scatter("x", "y", marker="x", size="cross", line_color=_REJECTED, source=self._patches)
        told = [
            ("patch", "@state"),
            ("distance", "@distance{0.000} mm"),
            ("correlation", "@correlation{0.000}"),
            ("standard deviation of the distance", "@sigma{0.000} mm"),
            ("at", "@x{0.0}, @y{0.0} mm"),
        ]
        self.plot.add_tools(HoverTool(renderers=[patches], tooltips=told))
        self._bar = ColorBar(color_mapper=self._colours, width=10, padding=4, visible=False)
        self.plot.add_layout(self._bar, "right")

    def show(self, image: ByteArray) -> None:
        """Draw an image, shape (row, column)."""
        self._image.data = {"image": [image]}

    def colour(self, patches: PatchValues | None, by: str, most: float) -> None:
        """Draw patches coloured by a quantity from zero to `most`; none where there are none."""
        self._bar.visible = patches is not None
        if patches is None:
            self._patches.data = {name: [] for name in _PATCHES}
            return
        known = np.isfinite(patches.distance_mm)
        used = np.ones(len(known), bool) if patches.used is None else patches.used
        rejected = known & ~used
        unmeasured = "correlated" if patches.used is None else "without a distance"
        columns = {
            "distance": patches.distance_mm,
            "sigma": patches.sigma_mm,
            "correlation": patches.correlation,
        }
        self._colours.high, self._bar.title = most, " / ".join(filter(None, [by, _UNITS[by]]))
        self._patches.data = columns | {
            "x": patches.centre_mm[:, 0],
            "y": patches.centre_mm[:, 1],
            "angle": patches.turn_rad,
            "value": columns[by],
            "alpha": np.where(np.isfinite(columns[by]), _OPACITY, 0.0),
            "line": np.where(rejected, _REJECTED, "#ffffff"),
            "cross": np.where(rejected, 16, 0),
            "state": np.where(rejected, "left out", np.where(known, "used", unmeasured)),
        }


class TimePlots:
    """Plots over the images' clock with a cursor at the frame; a click on any jumps there.

    Parameters
    ----------
    sweep : Sweep
    jump : callable
        Called with the frame that is clicked.
    """

    def __init__(self, sweep: Sweep, jump: Callable[[int], None]) -> None:
        self._time_s, self._jump = sweep.frame_time_s, jump
        self.interval_s = float(np.median(np.diff(self._time_s))) if len(sweep) > 1 else 0.04
        self._half_s = self.interval_s / 2
        ends = self._time_s[[0, -1]] + 2 * self._half_s * np.array([-1, 1])
        self._range = Range1d(start=float(ends[0]), end=float(ends[1]), min_interval=8 * self._half_s)
        self.cursor = Span(dimension="height", line_color="#cc0000", line_width=1.5)
        self._marks = ColumnDataSource({name: [] for name in ("row", "left", "right", "colour", "words")})
        self.marks = self._plot(_ROW_PX, y_range=FactorRange(factors=["no frame"]))
        marks = self.marks.hbar(
            "row", left="left", right="right", height=0.7, color="colour", source=self._marks
        )
        self.marks.add_tools(HoverTool(renderers=[marks], tooltips="@words"))
        self.marks.xaxis.visible = False

    def move(self, frame: int) -> None:
        """Put the cursor at a frame."""
        self.cursor.location = float(self._time_s[frame])

    def mark(self, flags: IntArray | None, doubts: Sequence[Doubt]) -> None:
        """Mark flagged frames, a row for every kind of flag there is, and stretches in doubt."""
        marks = [
            (name, frame, frame, FLAGGED, name)
            for flag, name in NAMES.items()
            for frame in ([] if flags is None else np.flatnonzero(flags & int(flag)).tolist())
        ]
        marks += [
            (doubt.about, *ends, DOUBTED, doubt.consequence) for doubt in doubts for ends in doubt.frames
        ]
        rows = list(dict.fromkeys(row for row, *_ in marks))
        self.marks.y_range.factors = rows[::-1] or ["no frame"]
        self.marks.height, self.marks.visible = _ROW_PX * max(len(rows), 1) + 6, bool(rows)
        self._marks.data = {
            "row": [row for row, *_ in marks],
            "left": [self._time_s[first] - self._half_s for _, first, *_ in marks],
            "right": [self._time_s[last] + self._half_s for _, _, last, *_ in marks],
            "colour": [mark[3] for mark in marks],
            "words": [mark[4] for mark in marks],
        }

    def stream(self, label: str, parts: Sequence[str], time_s: FloatArray, values: FloatArray) -> figure:
        """Plot of quantities of a sensor, shape (m, 3)."""
        plot = self._plot(145, y_axis_label=label, x_axis_label="time / s")
        for part, colour, column in zip(parts, _LINES, values.T, strict=True):
            plot.line(time_s, column, color=colour, line_width=1.4, legend_label=part)
        plot.add_layout(plot.legend[0], "right")
        plot.legend.update(padding=2, spacing=0, margin=2, label_text_font_size="11px", border_line_alpha=0.0)
        plot.axis.axis_label_text_font_style = "normal"
        return plot

    def _plot(self, height: int, **more: Any) -> figure:
        plot = figure(
            height=height,
            sizing_mode="stretch_width",
            x_range=self._range,
            tools="xpan,xwheel_zoom",
            active_scroll="xwheel_zoom",
            toolbar_location=None,
            min_border_left=_LEFT_PX,
            min_border_top=3,
            min_border_bottom=3,
            **more,
        )
        plot.add_layout(self.cursor)
        plot.on_event(Tap, lambda event: self._jump(int(np.argmin(np.abs(self._time_s - event.x)))))
        return plot
