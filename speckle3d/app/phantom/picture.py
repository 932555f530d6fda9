"""One frame of a recording as a figure, in pixels, with the shape that it has in millimetres."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from bokeh.models import ColumnDataSource, CrosshairTool, HoverTool, Image, LinearColorMapper, Range1d
from bokeh.palettes import Greys256
from bokeh.plotting import figure

from calibration.recording import Recording

USED, DROPPED, REGION = "#0072B2", "#D55E00", "#F0E442"
"""Colours of Okabe and Ito's palette, distinguishable with any colour vision."""
FOUND = "#56B4E9"
"""A lighter blue, seen on dark images."""

_GLANCES = 7
_LOWEST, _HIGHEST = 1.0, 99.9
"""Percentiles of grey levels that are drawn black and white."""


class Picture:
    """A figure of one frame at a time.

    Parameters
    ----------
    recording : Recording
    width, height : int
        Room for the frame, screen pixels.

    Attributes
    ----------
    plot : figure
        Columns to the right and rows down, from 0 at the centre of the first pixel.
    """

    def __init__(self, recording: Recording, width: int, height: int) -> None:
        _, columns, rows = recording.images.shape
        column_mm, row_mm = (float(size) for size in recording.pixel_mm)
        scale = min(width / (columns * column_mm), height / (rows * row_mm))
        self._images = recording.images
        self._levels = levels(recording)
        self.plot = figure(
            frame_width=round(columns * column_mm * scale),
            frame_height=round(rows * row_mm * scale),
            x_range=Range1d(start=-0.5, end=columns - 0.5, bounds=(-0.5 - columns, 2 * columns)),
            y_range=Range1d(start=rows - 0.5, end=-0.5, bounds=(-0.5 - rows, 2 * rows)),
            x_axis_label=f"column ({column_mm:.3g} mm apart)",
            y_axis_label=f"row ({row_mm:.3g} mm apart)",
            tools="pan,wheel_zoom,reset",
            toolbar_location="right",
            background_fill_color="#202020",
            name="picture",
        )
        self.plot.toolbar.logo = None
        self.plot.grid.visible = False
        self.plot.add_tools(CrosshairTool(line_alpha=0.3, line_color="white"))
        self._source = ColumnDataSource({"image": [np.zeros((rows, columns), np.uint8)]})
        greys = LinearColorMapper(palette=list(Greys256), low=0, high=255)
        glyph = Image(image="image", x=-0.5, y=-0.5, dw=columns, dh=rows, color_mapper=greys)
        drawn = self.plot.add_glyph(self._source, glyph)
        self.plot.add_tools(
            HoverTool(renderers=[drawn], tooltips=[("column, row", "$x{0.0}, $y{0.0}")], attachment="below")
        )

    def show(self, frame: int) -> npt.NDArray[Any]:
        """Draw a frame, and return it as it is, shape (column, row)."""
        image = self._images[frame]
        self._source.data = {"image": [as_bytes(image, self._levels)]}
        return image


def levels(recording: Recording) -> tuple[float, float]:
    """Grey levels drawn black and white: those of 8 bits, or what most pixels of a few frames lie between."""
    images = recording.images
    if images.dtype == np.uint8:
        return 0.0, 255.0
    chosen = np.unique(np.linspace(0, images.shape[0] - 1, _GLANCES).astype(int))
    held = np.concatenate([np.asarray(images[int(i)], np.float32).ravel()[::11] for i in chosen])
    held = held[np.isfinite(held)]
    low, high = np.percentile(held, (_LOWEST, _HIGHEST)) if held.size else (0.0, 1.0)
    return float(low), float(max(high, low + 1e-6))


def as_bytes(image: npt.NDArray[Any], shown: tuple[float, float]) -> npt.NDArray[np.uint8]:
    """Grey levels of 8 bits, shape (row, column), black and white at `shown`."""
    low, high = shown
    if image.dtype == np.uint8 and shown == (0.0, 255.0):
        return np.ascontiguousarray(image.T)
    share = (np.nan_to_num(np.asarray(image, np.float32), nan=low) - low) / (high - low)
    return np.ascontiguousarray((255.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8).T)
