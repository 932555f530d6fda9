"""Where the panels of a picture of cuts stand, in inches: as large as they can be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from speckle3d.study.figures import new_figure

LARGEST_IN = (9.0, 7.5)
"""Width and height that panels share."""

LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN, NAME_IN = 0.75, 0.95, 0.45, 0.5, 0.45
"""Borders of the figure, and the height of a panel's name above it."""

_ACROSS_IN, _DOWN_IN = 0.2, 0.62
"""Between panels side by side, and one above the other: for the lower one's name."""

_LEAST_IN, _MOST_IN, _NARROWEST_IN = 0.4, 7.0, 6.0
"""Sides of a panel, and width of a figure."""

_TICKS_PER_IN, _FEWEST_TICKS, _MOST_TICKS = 2.0, 2, 8


@dataclass(frozen=True)
class PanelLayout:
    """A grid of equal panels.

    Attributes
    ----------
    rows, columns : int
    panel_in : tuple of float
        Width and height of each.
    overlay : tuple of int
        Rows and columns from a mode's cut to its overlay.
    step : tuple of int
        Rows and columns from one mode to the next.
    """

    rows: int
    columns: int
    panel_in: tuple[float, float]
    overlay: tuple[int, int]
    step: tuple[int, int]

    def figure(self, below_in: float) -> Figure:
        """Make a figure that holds the panels, and something more below them."""
        across = self.columns * (self.panel_in[0] + _ACROSS_IN) - _ACROSS_IN
        down = self.rows * (self.panel_in[1] + _DOWN_IN) - _DOWN_IN
        width = max(LEFT_IN + across + RIGHT_IN, _NARROWEST_IN)
        return new_figure(width, TOP_IN + NAME_IN + down + BOTTOM_IN + below_in, None)

    def add_panel(self, figure: Figure, number: int, overlay: bool) -> Axes:
        """Add the panel of a mode's cut, or of its overlay, to the figure."""
        row = number * self.step[0] + overlay * self.overlay[0]
        column = number * self.step[1] + overlay * self.overlay[1]
        wide, tall = self.panel_in
        left = LEFT_IN + column * (wide + _ACROSS_IN)
        top = TOP_IN + NAME_IN + row * (tall + _DOWN_IN)
        axes = add_axes_in(figure, left, figure.get_figheight() - top - tall, wide, tall)
        axes.tick_params(labelleft=column == 0, labelsize="small")
        across, down = (
            int(np.clip(_TICKS_PER_IN * inches, _FEWEST_TICKS, _MOST_TICKS)) for inches in self.panel_in
        )
        axes.locator_params(axis="x", nbins=across)
        axes.locator_params(axis="y", nbins=down)
        return axes


def laid_out(count: int, size_mm: tuple[float, float], compared: bool) -> PanelLayout:
    """Choose the arrangement in which panels are largest.

    Parameters
    ----------
    count : int
        Modes.
    size_mm : tuple of float
        Width and height that a panel shows.
    compared : bool
        Whether every mode has an overlay, too.
    """
    # Cuts in a row or in a column; overlays below their cuts or beside them.
    ways = [(1, count, (0, 0), (0, 1)), (count, 1, (0, 0), (1, 0))]
    if compared:
        ways = [(2, count, (1, 0), (0, 1)), (1, 2 * count, (0, 1), (0, 2)), (count, 2, (0, 1), (1, 0))]
    width, height = size_mm
    sizes = []
    for rows, columns, *_ in ways:
        across = (LARGEST_IN[0] + _ACROSS_IN) / columns - _ACROSS_IN
        down = (LARGEST_IN[1] + _DOWN_IN) / rows - _DOWN_IN
        scale = min(max(across, _LEAST_IN) / width, max(down, _LEAST_IN) / height, _MOST_IN / max(size_mm))
        sizes.append((max(scale * width, _LEAST_IN), max(scale * height, _LEAST_IN)))
    best = int(np.argmax([np.prod(size) for size in sizes]))
    rows, columns, overlay, step = ways[best]
    return PanelLayout(rows, columns, sizes[best], overlay, step)


def add_axes_in(figure: Figure, left_in: float, low_in: float, width_in: float, height_in: float) -> Axes:
    """Add axes by where they are from the figure's lower left."""
    wide, tall = figure.get_size_inches()
    return figure.add_axes((left_in / wide, low_in / tall, width_in / wide, height_in / tall))


def name_axes(panels: Sequence[Axes], names: tuple[str, str]) -> None:
    """Name x below the lowest panel at the left, and y beside all panels there."""
    places = [each.get_position() for each in panels]
    left = min(place.x0 for place in places)
    at_left = [(place.y0, each) for each, place in zip(panels, places, strict=True) if place.x0 < left + 1e-6]
    for _, axes in at_left:
        axes.set_ylabel(f"{names[1]} / mm")
    min(at_left, key=lambda each: each[0])[1].set_xlabel(f"{names[0]} / mm", loc="left")
