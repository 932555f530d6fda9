"""What is measured between clicked points, and the command that says the same."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path

import panel as pn
from panel.viewable import Viewable

from speckle3d.app.reconstruction.commands import measure_command
from speckle3d.app.reconstruction.measuring import Picked
from speckle3d.app.reconstruction.saving import code
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import Speckle3DError
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.study.figures import label_of

_HELP = (
    "Click on points in a cut, two or more: distances, the line's length and angles, with standard errors."
)


class MeasureView:
    """Clicked points of every mode, and what is measured between those of the mode clicked in last.

    Parameters
    ----------
    reconstruction : Reconstruction
    source : str
        Name of its file.
    width_px : int
    changed : callable
        Called with all points by mode when there are others.
    """

    def __init__(
        self, reconstruction: Reconstruction, source: str, width_px: int, changed: Callable[[], None]
    ) -> None:
        self._reconstruction, self._source, self._changed = reconstruction, source, changed
        self._picked: dict[str, Picked] = {}
        self._mode = "image"
        half = width_px // 2 - 10
        self._undo = pn.widgets.Button(name="remove the last", width=half)
        self._clear = pn.widgets.Button(name="remove all", width=half)
        self._undo.on_click(lambda _: self._keep(Picked(self._mode, self.points[self._mode][:-1])))
        self._clear.on_click(lambda _: self._keep(Picked(self._mode)))
        self._said = pn.pane.HTML(_HELP, width=width_px)

    @property
    def points(self) -> dict[str, tuple[FloatArray, ...]]:
        """Points by mode, in its world."""
        return {mode: each.points_mm for mode, each in self._picked.items()} | (
            {} if self._mode in self._picked else {self._mode: ()}
        )

    def layout(self) -> Viewable:
        """The widgets below each other."""
        return pn.Column(pn.Row(self._undo, self._clear, margin=0), self._said, margin=0)

    def add(self, mode: str, point_mm: FloatArray) -> None:
        """Take a point that was clicked on; say why if it cannot be taken."""
        self._mode = mode
        try:
            self._keep(self._picked.get(mode, Picked(mode)).with_point(point_mm, self._reconstruction))
        except Speckle3DError as error:
            self._said.object = f"<span style='color:#a03000'>{escape(str(error))}</span>"

    def _keep(self, picked: Picked) -> None:
        self._picked[picked.mode] = picked
        rows = "".join(
            f"<tr><td>{number + 1}</td>" + "".join(f"<td>{value:.2f}</td>" for value in point) + "</tr>"
            for number, point in enumerate(picked.points_mm)
        )
        head = "<tr><th></th><th>x / mm</th><th>y / mm</th><th>z / mm</th></tr>"
        table = f"<table style='text-align:right;border-spacing:10px 0'>{head}{rows}</table>"
        lines = "".join(
            f"<p style='margin:4px 0'>{escape(line)}</p>" for line in picked.measured(self._reconstruction)
        )
        world = f"<b>{escape(label_of(picked.mode))}</b>, points of its world:"
        command = measure_command(Path(self._source), picked.mode, picked.points_mm)
        self._said.object = (
            f"{world}{table}{lines}{code(command) if lines else ''}" if picked.points_mm else _HELP
        )
        self._changed()
