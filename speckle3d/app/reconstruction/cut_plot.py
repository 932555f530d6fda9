"""A plot of one cut: its image in mm, the cross hair, and measured points."""

from collections.abc import Callable

import numpy as np
from bokeh.events import Tap
from bokeh.models import ColumnDataSource
from bokeh.models.annotations import Span
from scipy.spatial.transform import RigidTransform

from speckle3d.app.plots import ImagePlot, greys
from speckle3d.core.arrays import FloatArray
from speckle3d.study.reslices.cuts import CutPicture

_OVERLAY_PERCENTILES = (5.0, 99.5)
"""Levels that are dark and bright where one cut is laid over another, so that the colours are strong."""
_NEAR_MM = 0.3
"""A point is drawn in the cuts as near as this."""


class CutPlot(ImagePlot):
    """A plot of one cut.

    Parameters
    ----------
    name : str
        Of the plot's model, by which it is found.
    colours : tuple of str
        Of the upright and of the level line of the cross hair: those of the sliders that move them.
    on_tap : callable
        Called with the point of the world that was clicked on, shape (3,), mm.
    """

    def __init__(self, name: str, colours: tuple[str, str], on_tap: Callable[[FloatArray], None]) -> None:
        super().__init__("", "", name=f"cut-{name}", title=" ", active_drag=None)
        self._world_from_picture: RigidTransform | None = None
        self.plot.title.update(text_font_size="12px", text_font_style="normal")
        self._lines = tuple(
            Span(dimension=dimension, line_color=colour, line_width=1.5)
            for dimension, colour in zip(("height", "width"), colours, strict=True)
        )
        for line in self._lines:
            self.plot.add_layout(line)
        self._points = ColumnDataSource({"x": [], "y": [], "number": []})
        self.plot.line("x", "y", color="white", line_dash=[4, 3], source=self._points)
        self.plot.scatter("x", "y", size=8, color="#ff3030", line_color="white", source=self._points)
        self.plot.text("x", "y", "number", x_offset=6, y_offset=-3, color="#ffe600", source=self._points)
        self.plot.on_event(Tap, lambda event: self._tell(on_tap, event))

    def show_cut(self, picture: CutPicture, mode: str, overlay: str | None) -> None:
        """Show a cut at the poses of one mode, or of another (magenta) laid over it (green)."""
        image, plane = picture.cuts[mode].image, picture.cuts[mode].cut
        if overlay is None:
            colours = greys(image, *picture.levels)
        else:
            # Of what the other is laid over: dark and bright, so that the colours are strong.
            dark, bright = np.nanpercentile(image, _OVERLAY_PERCENTILES)
            layers = np.stack([picture.cuts[overlay].image, image])
            magenta, green = np.nan_to_num(np.clip((layers - dark) / max(bright - dark, 1e-3), 0.0, 1.0))
            alpha = np.isfinite(layers).any(axis=0)
            colours = np.rint(255 * np.dstack([magenta, green, magenta, alpha])).astype(np.uint8)
        self.show(colours, plane.first_mm, (plane.pixel_mm,) * 2)
        self._world_from_picture = plane.world_from_picture
        self.plot.title.text = picture.place.split(", seen")[0]
        self.plot.xaxis.axis_label, self.plot.yaxis.axis_label = (f"{name} / mm" for name in picture.axes)

    def show_points(self, cross_mm: FloatArray, points_mm: FloatArray) -> None:
        """Put the cross hair at a point of the world, shape (3,), and draw others, shape (k, 3), mm."""
        if self._world_from_picture is None:
            return
        inside = self._world_from_picture.inv().apply(np.vstack([cross_mm, points_mm]))
        x, y = inside[:, :2].T
        for line, place in zip(self._lines, (x[0], y[0]), strict=True):
            line.location = float(place)
        x[np.abs(inside[:, 2]) > _NEAR_MM] = np.nan
        numbers = [str(k + 1) for k in range(len(points_mm))]
        self._points.data = {"x": x[1:], "y": y[1:], "number": numbers}

    def _tell(self, on_tap: Callable[[FloatArray], None], event: Tap) -> None:
        if self._world_from_picture is not None and event.x is not None and event.y is not None:
            on_tap(self._world_from_picture.apply([event.x, event.y, 0.0]))
