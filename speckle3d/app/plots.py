"""Plots that pages share: an image with its axes, and lines over the time."""

from collections.abc import Callable
from typing import Any

import numpy as np
from bokeh.events import Tap
from bokeh.models import ColumnDataSource, DataRange1d, Range1d
from bokeh.models.annotations import Span
from bokeh.plotting import figure
from matplotlib import colormaps

from speckle3d.core.arrays import AnyArray, ByteArray
from speckle3d.study.figures import UNSEEN

Pair = tuple[float, float]


def empty_plot(across: str, down: str, **look: Any) -> figure:
    """Plot with the labels of its axes, by default as large as there is room."""
    plot = figure(x_axis_label=across, y_axis_label=down, **{"sizing_mode": "stretch_both", **look})
    plot.axis.axis_label_text_font_style = "normal"
    plot.toolbar.logo = None
    return plot


def time_plot(
    label: str, x_range: Range1d, cursor: Span, on_tap: Callable[[float], object], **look: Any
) -> figure:
    """Plot over a time that several share, with a cursor; `on_tap` is called with the time of a click."""
    tools = {"tools": "xpan,xwheel_zoom,reset", "active_scroll": "xwheel_zoom", "toolbar_location": None}
    plot = empty_plot("", label, x_range=x_range, **tools, **look)
    plot.add_layout(cursor)
    plot.on_event(Tap, lambda event: on_tap(event.x))
    return plot


class ImagePlot:
    """A plot of one image at a time, depth downwards.

    Parameters
    ----------
    across, down : str
        Labels of the axes.
    tools : str
        More tools than pan, zoom, reset and save.
    **look
        Attributes of the figure.
    """

    def __init__(self, across: str, down: str = "depth / mm", tools: str = "", **look: Any) -> None:
        self.plot = empty_plot(
            across,
            down,
            match_aspect=True,
            x_range=DataRange1d(),
            y_range=DataRange1d(flipped=True),
            tools=f"pan,wheel_zoom,reset,save,{tools}".strip(","),
            active_scroll="wheel_zoom",
            background_fill_color=UNSEEN,
            **look,
        )
        self.plot.grid.visible = False
        self.source = ColumnDataSource({name: [] for name in ("image", "x", "y", "dw", "dh")})
        image = self.plot.image_rgba("image", "x", "y", "dw", "dh", source=self.source)
        # What is drawn over it must not move it.
        self.plot.x_range.renderers = self.plot.y_range.renderers = [image]

    def show(self, colours: ByteArray, first: Pair, pitch: Pair) -> None:
        """Draw an image, shape (row, column, 4), whose first pixel's centre and pitch are given as (x, y)."""
        rows, columns = colours.shape[:2]
        pixels = np.ascontiguousarray(colours).view(np.uint32)[..., 0]
        place = {"x": [first[0] - pitch[0] / 2], "y": [first[1] - pitch[1] / 2]}
        size = {"dw": [columns * pitch[0]], "dh": [rows * pitch[1]]}
        self.source.data = {"image": [pixels], **place, **size}


def greys(image: AnyArray, low: float, high: float) -> ByteArray:
    """Colours of grey levels from black to white, shape (row, column, 4); NaN is what nobody has seen."""
    scale = colormaps["gray"].with_extremes(bad=UNSEEN)
    return np.asarray(scale((image - low) / max(high - low, 1e-6), bytes=True))
