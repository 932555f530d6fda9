"""One cut as it is drawn: its image in mm, lines of other cuts, handles of the free plane, picked points."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from bokeh.events import Tap
from bokeh.models import ColumnDataSource, Range1d
from bokeh.models.annotations import BoxAnnotation, Span, Title
from bokeh.plotting import figure

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.study.figures import UNSEEN
from speckle3d.study.reslices.reslice_figures import contrast_of, overlay

FREE, FRAME, LATERAL, DEPTH = "#ff4fc3", "#ffd700", "#4fc3ff", "#8de04f"
"""Colours of the free plane's lines and of the other cuts'."""
_HANDLE_PX = 11
HELD_S = 0.8
"""For so long after its last move a handle counts as held: the browser does not tell when it is let go."""
_MARGIN = 0.03


def grey(image_db: Float32Array, levels: tuple[float, float]) -> npt.NDArray[np.uint32]:
    """A cut in grey from the first of the levels to the second, packed as red, green, blue and opaque."""
    low, high = levels
    shade = np.clip((image_db - low) / (high - low), 0.0, 1.0)
    colours = np.repeat(shade[..., None], 3, axis=2)
    colours[np.isnan(shade)] = [int(UNSEEN[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    return _packed(colours)


def laid_over(
    image_db: Float32Array, reference_db: Float32Array, levels: tuple[float, float]
) -> npt.NDArray[np.uint32]:
    """A cut (magenta) over that of the reference (green), where both agree grey; packed as `grey`."""
    return _packed(overlay(image_db, reference_db, contrast_of(reference_db, levels)))


def _packed(colours: FloatArray | Float32Array) -> npt.NDArray[np.uint32]:
    packed = np.full((*colours.shape[:2], 4), 255, np.uint8)
    packed[..., :3] = np.rint(255 * colours)
    return packed.view(np.uint32)[..., 0]


@dataclass(frozen=True)
class Box:
    """What the axes say at the borders of a cut, mm."""

    left: float
    right: float
    bottom: float
    top: float

    def scaled_to(self, width: float, height: float) -> Box:
        """A box about this one with the sides' ratio of a picture: a millimetre is as long both ways."""
        wide, tall = (1 + _MARGIN) * (self.right - self.left), (1 + _MARGIN) * (self.bottom - self.top)
        scale = max(wide / width, tall / height)
        x, y = (self.left + self.right) / 2, (self.bottom + self.top) / 2
        half_x, half_y = scale * width / 2, scale * height / 2
        return Box(x - half_x, x + half_x, y + half_y, y - half_y)

    def line(self, normal: FloatArray, offset: float) -> FloatArray | None:
        """Ends of a line ``normal @ p == offset`` within the box, shape (2, 2); None if it misses."""
        along = np.array([-normal[1], normal[0]])
        foot = offset * normal
        low, high = -np.inf, np.inf
        for axis, (start, stop) in enumerate(((self.left, self.right), (self.top, self.bottom))):
            if abs(along[axis]) < 1e-9:
                if not start <= foot[axis] <= stop:
                    return None
                continue
            ends = sorted(((start - foot[axis]) / along[axis], (stop - foot[axis]) / along[axis]))
            low, high = max(low, ends[0]), min(high, ends[1])
        return np.array([foot + low * along, foot + high * along]) if low < high else None


class CutPlot:
    """A plot of one cut, which is told what to show and tells what the mouse does.

    Parameters
    ----------
    name : str
        Of the plot's model, by which it is found.
    size_px : tuple of int
        Width and height within the axes.
    picked : callable
        Called with x and y of a click, mm by the axes.
    """

    def __init__(self, name: str, size_px: tuple[int, int], picked: Callable[[float, float], None]) -> None:
        self.box = Box(0.0, 1.0, 1.0, 0.0)
        self._size = size_px
        self._across, self._down = Range1d(start=0, end=1), Range1d(start=1, end=0)
        self._title = Title(text="making the cut", text_font_size="11px", text_font_style="normal")
        self.plot = figure(
            name=name,
            frame_width=size_px[0],
            frame_height=size_px[1],
            x_range=self._across,
            y_range=self._down,
            title=self._title,
            tools="pan,wheel_zoom,reset",
            active_drag=None,
            active_scroll="wheel_zoom",
            toolbar_location="above",
            min_border=4,
        )
        self.plot.toolbar.logo = None
        self.plot.toolbar.autohide = True
        self.plot.grid.visible = False
        self.plot.background_fill_color = UNSEEN
        for axis in self.plot.axis:
            axis.axis_label_text_font_style = "normal"
            axis.axis_label_text_font_size = axis.major_label_text_font_size = "11px"
            axis.axis_label_standoff = 2
            # Until it is known what they say.
            axis.major_label_text_alpha = 0.0
        blank = np.zeros((1, 1), np.uint32)
        self.image = ColumnDataSource({"image": [blank], "x": [0.0], "y": [0.0], "w": [1.0], "h": [1.0]})
        self.plot.image_rgba("image", "x", "y", "w", "h", source=self.image)
        self._frames = ColumnDataSource({"xs": [], "ys": [], "colour": []})
        self.plot.multi_line("xs", "ys", color="colour", line_width=1.5, source=self._frames)
        self._points = ColumnDataSource({"x": [], "y": [], "number": []})
        self.plot.line("x", "y", color="white", line_dash=[4, 3], source=self._points)
        self.plot.scatter("x", "y", size=8, color="#ff3030", line_color="white", source=self._points)
        self.plot.text(
            "x", "y", "number", x_offset=6, y_offset=-3, color="#ffe600", text_font_size="14px",
            text_font_style="bold", source=self._points,
        )  # fmt: skip
        self.plot.on_event(Tap, lambda event: picked(float(event.x), float(event.y)))

    def resize(self, size_px: tuple[int, int]) -> None:
        """Make the picture of another width and height."""
        self._size = size_px
        self.plot.update(frame_width=size_px[0], frame_height=size_px[1])

    def fit(self, box: Box) -> None:
        """Show this part of the plane, a millimetre as long across as down."""
        self.box = box
        shown = box.scaled_to(*self._size)
        self._across.update(start=shown.left, end=shown.right, reset_start=shown.left, reset_end=shown.right)
        self._down.update(start=shown.bottom, end=shown.top, reset_start=shown.bottom, reset_end=shown.top)

    def show(self, colours: npt.NDArray[np.uint32], extent_mm: tuple[float, float, float, float]) -> None:
        """Show an image between left, right, bottom and top."""
        left, right, bottom, top = extent_mm
        place = {"x": [left], "y": [top], "w": [right - left], "h": [bottom - top]}
        self.image.data = {"image": [colours], **place}

    @property
    def mm_per_px(self) -> float:
        """Size of a pixel of the screen."""
        across: Any = self._across  # Bokeh has it that ranges may be of dates
        return float(abs(across.end - across.start) / self._size[0])

    def title(self, text: str) -> None:
        """Write above the plot."""
        self._title.text = text

    def name_axes(self, title: str, axes: tuple[str, str]) -> None:
        """Write where the cut is, and what its axes are."""
        self.title(title)
        self.plot.xaxis.axis_label, self.plot.yaxis.axis_label = (f"{each} / mm" for each in axes)
        for axis in self.plot.axis:
            axis.major_label_text_alpha = 1.0

    def show_lines(self, lines: Sequence[tuple[FloatArray, str]]) -> None:
        """Draw lines, shape (m, 2) each, in their colours."""
        self._frames.data = {
            "xs": [line[:, 0] for line, _ in lines],
            "ys": [line[:, 1] for line, _ in lines],
            "colour": [colour for _, colour in lines],
        }

    def show_points(self, points_mm: FloatArray, numbers: Sequence[str]) -> None:
        """Draw picked points, shape (k, 2), joined in their order."""
        self._points.data = {"x": points_mm[:, 0], "y": points_mm[:, 1], "number": list(numbers)}

    def add_span(
        self, dimension: Literal["width", "height"], colour: str, moved: Callable[[float], None]
    ) -> Span:
        """Add a line across the plot that can be dragged."""
        span = Span(dimension=dimension, line_color=colour, line_width=1.5, editable=True)
        span.hover_line_width = 4
        span.on_change("location", lambda attr, old, new: moved(float(new)))
        self.plot.add_layout(span)
        return span


class Handle:
    """A small square in a plot that the mouse can drag.

    Parameters
    ----------
    round_ : bool
        Draw it round: it turns something.
    moved : callable
        Called with its old and its new place, shape (2,) each, mm by the axes.
    """

    def __init__(
        self, plot: CutPlot, colour: str, round_: bool, moved: Callable[[FloatArray, FloatArray], None]
    ) -> None:
        self.at = np.zeros(2)
        self._plot, self._moved, self._placing = plot, moved, False
        self._dragged_s = -np.inf
        look: dict[str, Any] = {"border_radius": _HANDLE_PX if round_ else 0}
        self.box = BoxAnnotation(
            left=0, right=1, top=0, bottom=1, editable=True, movable="both", resizable="none",
            fill_color=colour, fill_alpha=0.85, line_color="white", line_width=1.5,
            hover_fill_color="white", hover_fill_alpha=0.9,
            visible=False, use_handles=False, **look,
        )  # fmt: skip
        for side in ("left", "right", "top", "bottom"):
            self.box.on_change(side, lambda attr, old, new: self._dragged())
        plot.plot.add_layout(self.box)

    @property
    def is_held(self) -> bool:
        """Whether the mouse moved it a moment ago; placed now, it would be torn between both."""
        return time.monotonic() - self._dragged_s < HELD_S

    def place(self, at_mm: FloatArray | None) -> None:
        """Put it somewhere, or nowhere."""
        self.box.visible = at_mm is not None
        if at_mm is None:
            return
        half = _HANDLE_PX / 2 * self._plot.mm_per_px
        self.at = np.asarray(at_mm, dtype=float)
        self._placing = True
        self.box.update(
            left=self.at[0] - half, right=self.at[0] + half, top=self.at[1] - half, bottom=self.at[1] + half
        )
        self._placing = False

    def _dragged(self) -> None:
        if self._placing:
            return
        box: Any = self.box
        new = np.array([(box.left + box.right) / 2, (box.top + box.bottom) / 2], dtype=float)
        old, self.at = self.at, new
        self._dragged_s = time.monotonic()
        if not np.array_equal(old, new):
            self._moved(old, new)
