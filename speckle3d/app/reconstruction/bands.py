"""Length, tilt, yaw and roll of every mode over the frames, with the 95 % interval that each claims."""

from __future__ import annotations

import numpy as np
from bokeh.models import ColumnDataSource
from bokeh.models.annotations import Span
from bokeh.plotting import figure

from speckle3d.app.reconstruction.cuts.cut_plot import FRAME
from speckle3d.app.reconstruction.cuts.material import Material
from speckle3d.imaging.measures.measure import NORMAL_95
from speckle3d.scoring.references import sweep_curves
from speckle3d.study.figures import CURVE_LABELS, colour_of

QUANTITIES = ("length", "tilt", "yaw", "roll")


class BandsPlot:
    """A plot of one quantity of all modes over the frames.

    Parameters
    ----------
    material : Material
    """

    def __init__(self, material: Material, size_px: tuple[int, int]) -> None:
        poses = {mode: material.opened(mode).poses[mode] for mode in material.modes}
        self._curves = sweep_curves(poses, material.grid.centre_mm).modes
        self._half_width = {}
        for mode in material.modes:
            errors = material.errors(mode)
            if errors is not None:
                own = NORMAL_95 * np.sqrt(np.diagonal(errors, axis1=1, axis2=2)).T[2:]
                own[1:] = np.rad2deg(own[1:])
                self._half_width[mode] = own
        self.plot = figure(
            name="bands", width=size_px[0], height=size_px[1], tools="pan,wheel_zoom,reset",
            active_drag=None, toolbar_location=None, min_border=4,
        )  # fmt: skip
        self.plot.xaxis.axis_label = "frame"
        for axis in self.plot.axis:
            axis.axis_label_text_font_style = "normal"
            axis.axis_label_text_font_size = axis.major_label_text_font_size = "11px"
        self._sources = {mode: ColumnDataSource({"x": [], "y": [], "low": [], "high": []}) for mode in poses}
        for mode, source in self._sources.items():
            colour = colour_of(mode, material.modes)
            if mode in self._half_width:
                self.plot.varea("x", "low", "high", color=colour, alpha=0.15, source=source)
            self.plot.line("x", "y", color=colour, line_width=2, source=source)
        self.cursor = Span(dimension="height", line_color=FRAME, line_width=2)
        self.plot.add_layout(self.cursor)
        self.show(QUANTITIES[0])

    def show(self, quantity: str) -> None:
        """Show one of `QUANTITIES`."""
        at = QUANTITIES.index(quantity)
        self.plot.yaxis.axis_label = CURVE_LABELS[at]
        for mode, source in self._sources.items():
            values = self._curves[mode][at]
            half = self._half_width[mode][at] if mode in self._half_width else np.zeros_like(values)
            source.data = {
                "x": np.arange(len(values)), "y": values, "low": values - half, "high": values + half,
            }  # fmt: skip
