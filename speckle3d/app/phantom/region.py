"""The region of an image outside which nothing counts, drawn with the mouse or typed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import panel as pn
from bokeh.events import SelectionGeometry
from bokeh.models import BoxSelectTool, ColumnDataSource, PolyDrawTool, PolyEditTool
from panel.viewable import Viewable

from speckle3d.app.phantom.picture import REGION
from speckle3d.app.phantom.work import in_turn
from speckle3d.calibrating.settings import Corners, region_of, region_text
from speckle3d.core.errors import InvalidInputError

_DIGITS = 1
"""Decimal places of a corner's column and row: a mouse knows no more, and a command can be given them."""


class Region:
    """A polygon over a picture.

    Parameters
    ----------
    plot : figure
    given : tuple of corners, optional
        To begin with.
    changed : callable
        Called when the region is another one.
    """

    def __init__(self, plot: Any, given: Corners | None, changed: Callable[[], None]) -> None:
        self.corners = given
        self._changed = changed
        self._source = ColumnDataSource(_data(given), name="region")
        patches = plot.patches(
            "xs", "ys", source=self._source, fill_alpha=0.06, color=REGION, line_width=2, line_dash="dashed"
        )
        vertices = plot.scatter([], [], size=9, color=REGION)
        drawing = PolyDrawTool(
            renderers=[patches],
            num_objects=1,
            drag=False,
            vertex_renderer=vertices,
            description="Draw the region as a polygon",
        )
        plot.add_tools(
            drawing,
            PolyEditTool(renderers=[patches], vertex_renderer=vertices, description="Edit the region"),
        )
        box = BoxSelectTool(renderers=[vertices], description="Drag a box as the region")
        plot.add_tools(box)
        # One tool at a time hears the mouse.
        plot.toolbar.active_tap, plot.toolbar.active_drag = None, box
        plot.on_event(SelectionGeometry, self._boxed)
        self._text = pn.widgets.TextInput(
            name="",
            value="" if given is None else region_text(given),
            placeholder='region: "column,row column,row ..."',
            width=290,
        )
        self._clear = pn.widgets.Button(name="No region", width=90)
        self._source.on_change("data", self._drawn)
        self._text.param.watch(in_turn(self._typed), "value")
        self._clear.on_click(in_turn(partial(self._set, None)))

    def controls(self) -> Viewable:
        """The region as text, and a button to be without."""
        return pn.Row(self._text, self._clear)

    def _drawn(self, attribute: str, old: object, new: Any) -> None:
        shapes = list(zip(new["xs"], new["ys"], strict=True))
        if not shapes:
            self._take(None)
            return
        columns, rows = shapes[-1]
        corners: list[tuple[float, float]] = []
        for column, row in zip(columns, rows, strict=True):
            corner = (round(float(column), _DIGITS), round(float(row), _DIGITS))
            if corner not in corners:
                corners.append(corner)
        # While it is being drawn, it is no polygon yet.
        if len(corners) >= 3:
            self._take(tuple(corners))

    def _boxed(self, event: SelectionGeometry) -> None:
        held: Any = event.geometry
        if not event.final or held["type"] != "rect":
            return
        left, right, top, bottom = (round(float(held[end]), _DIGITS) for end in ("x0", "x1", "y0", "y1"))
        left, right, top, bottom = min(left, right), max(left, right), min(top, bottom), max(top, bottom)
        if left < right and top < bottom:
            self._set(((left, top), (right, top), (right, bottom), (left, bottom)))

    def _typed(self) -> None:
        try:
            corners = region_of((self._text.value or "").strip())
        except InvalidInputError:
            self._text.value = "" if self.corners is None else region_text(self.corners)
            return
        if corners != self.corners:
            self._set(corners)

    def _set(self, corners: Corners | None) -> None:
        self._source.data = _data(corners)
        self._take(corners)

    def _take(self, corners: Corners | None) -> None:
        if corners == self.corners:
            return
        self.corners = corners
        self._text.value = "" if corners is None else region_text(corners)
        self._changed()


def _data(corners: Corners | None) -> dict[str, list[list[float]]]:
    if corners is None:
        return {"xs": [], "ys": []}
    return {"xs": [[column for column, _ in corners]], "ys": [[row for _, row in corners]]}
