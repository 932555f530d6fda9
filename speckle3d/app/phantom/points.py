"""The tuner of wires: points picked, moved and deleted with the mouse, and the calibration with them."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, PointDrawTool
from panel.viewable import Viewable

from calibration.points import Detections, Recording
from calibration.recording import choose_crossings
from speckle3d.app.look import batch_changes
from speckle3d.app.phantom.plots import BLUE, ORANGE, SKY_BLUE
from speckle3d.app.phantom.viewer import PhantomViewer, new_path, run_in_thread, sentence
from speckle3d.calibrating.phantoms import WireSetup, detect_phantom, detections_by_hand
from speckle3d.calibrating.settings import ScanSettings, WireSettings, with_values
from speckle3d.core.arrays import AnyArray
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.io.points import PickedPoints, read_points, write_points

_HINT = "Click: add. Drag: move. Click a point and press Backspace: delete."
_DIGITS = 3
"""Decimal places of a column and row in a file of points."""
_NO_POINTS: dict[str, list[Any]] = {"column": [], "row": [], "wire": []}


class PointsViewer(PhantomViewer):
    """Dots of wires, or places where wires cross, in the frames of a recording; as `PhantomViewer`.

    Raises
    ------
    FileError, InvalidInputError
        If the phantom or the points cannot be read, or do not fit the recording.
    """

    def __init__(self, recording: Recording, images: Path, settings: ScanSettings) -> None:
        assert isinstance(settings, WireSettings)
        super().__init__(recording, images, settings)
        self._phantom, self._drawing = WireSetup.of(settings.phantom), False
        # Where the wires are not told apart, a frame has one point.
        self._names = self._phantom.names or ("",)
        self._picks: dict[int, dict[str, tuple[float, float]]] = {}
        if settings.points is not None:
            points = read_points(settings.points, self._phantom.names)
            points.require_inside(recording.images.shape)
            self._take(points)
        self._points = ColumnDataSource(_NO_POINTS, name="points")
        self._points.on_change("data", self._edit)
        dots = self.frame_plot.plot.scatter(
            "column", "row", source=self._points, size=11, line_color=SKY_BLUE, line_width=2, fill_alpha=0.0
        )
        self.frame_plot.plot.text(
            "column",
            "row",
            "wire",
            source=self._points,
            x_offset=8,
            y_offset=-4,
            text_color=SKY_BLUE,
            text_font_size="11px",
        )
        count = 0 if self._phantom.names else 1
        self._tool = PointDrawTool(renderers=[dots], empty_value="", num_objects=count)
        self.frame_plot.plot.add_tools(self._tool)
        self.frame_plot.plot.toolbar.active_tap = self.frame_plot.plot.toolbar.active_drag = self._tool
        self._wire = pn.widgets.Select(
            name="wire of the next point", options=[*self._phantom.names], width=170
        )
        self._wire.param.watch(self._name_next, "value")
        self._search = pn.widgets.Button(
            name="Find points in all frames", width=190, disabled=not self._phantom.is_detectable
        )
        self._points_name = pn.widgets.TextInput(
            name="file of the points", value=f"{images.stem}-points.csv", width=460
        )
        self._points_note = pn.pane.HTML("", width=600)

    def view(self) -> Viewable:
        """Lay out what finds, picks and saves points."""
        save = pn.widgets.Button(name="Save points", width=110, align="end")
        save.on_click(self._save_points)
        self._search.on_click(self._find_all)
        wires = [self._wire] if self._phantom.names else []
        buttons = pn.Row(self._search, *wires)
        files = pn.Row(save, self._points_name)
        return self.layout(pn.pane.HTML(_HINT, width=600), buttons, files, self._points_note)

    def show(self, image: AnyArray, settings: ScanSettings) -> str:
        """Draw the points of a frame, and count them."""
        points = self._picks.get(self.frame, {})
        column, row = zip(*points.values(), strict=True) if points else ((), ())
        self._drawing = True
        self._points.data = {"column": list(column), "row": list(row), "wire": list(points)}
        self._drawing = False
        missing = [name for name in self._phantom.names if name not in points]
        if missing and self._wire.value not in missing:
            self._wire.value = missing[0]
        self._name_next()
        lacking = f"none on {', '.join(missing)}" if points and missing else self._refusals.get(self.frame)
        total = sum(map(len, self._picks.values()))
        words = f"frame {self.frame}: {len(points)} points", lacking, f"{total} in {len(self._picks)} frames"
        return "; ".join(filter(None, words))

    def find(self, settings: ScanSettings) -> Detections:
        """Take the points that are there."""
        return detections_by_hand(self.recording, self._points_by_hand(), settings)

    def before_saving(self, settings: ScanSettings, out: Path) -> ScanSettings:
        """Save the points, which are those of the calibration, for the command to be given them."""
        return with_values(settings, {"points": self._write(f"{out.stem}-points")})

    def _edit(self, attribute: str, old: object, new: Any) -> None:
        if not self._drawing:
            points = {
                wire: (round(column, _DIGITS), round(row, _DIGITS))
                for column, row, wire in zip(new["column"], new["row"], new["wire"], strict=True)
                if wire in self._names
            }
            self._picks |= {self.frame: points}
            self._mark_picks()

    def _take(self, points: PickedPoints | Detections) -> None:
        """Take points of many frames, in place of all that were there."""
        wires = np.zeros(len(points.frame), int) if points.wire is None else points.wire
        self._picks.clear()
        for frame, wire, (column, row) in zip(
            points.frame.tolist(), wires.tolist(), points.pixels.round(_DIGITS).tolist(), strict=True
        ):
            self._picks.setdefault(frame, {})[self._names[wire]] = column, row

    def _points_by_hand(self) -> PickedPoints:
        """All points, by frame and wire, as they are written into a file."""
        rows = sorted(
            (frame, self._names.index(wire), *place)
            for frame, points in self._picks.items()
            for wire, place in points.items()
        )
        if not rows:
            raise InvalidInputError("expected points: find them, or click where they are; got none")
        frame, wire, *pixels = np.array(rows).T
        wires = wire.astype(np.int64) if self._phantom.names else None
        return PickedPoints(frame.astype(np.int64), np.column_stack(pixels), wires)

    def _mark_picks(self) -> None:
        self._picks = {frame: points for frame, points in self._picks.items() if points}
        self.mark_frames(dict.fromkeys(self._picks, "has points"), self._refusals)
        self.changed()

    @batch_changes
    def _name_next(self, *_: Any) -> None:
        self._tool.default_overrides = {"wire": self._wire.value or ""}

    async def _find_all(self, _: object) -> None:
        try:
            settings = self.settings().model_copy(update={"points": None})
            self.tell("finding points in all frames ...")
            points = await run_in_thread(self._search, partial(self._find_points, settings))
        except Speckle3DError as error:
            self.tell(str(error), ORANGE)
            return
        self._take(points)
        self._refusals = points.dropped
        self._mark_picks()

    def _find_points(self, settings: ScanSettings) -> Detections:
        points = detect_phantom(self.recording, settings)
        if self._phantom.names:
            return points
        return choose_crossings(self.recording, points, [self.recording.time_offset_s])

    def _save_points(self, _: object) -> None:
        try:
            path = self._write(self._points_name.value or "")
            self._points_note.object = sentence(f"Saved {path}", BLUE, "saved")
        except Speckle3DError as error:
            self._points_note.object = sentence(str(error), ORANGE, "saved")

    def _write(self, name: str) -> Path:
        points, path = self._points_by_hand(), new_path(self.folder, name, ".csv")
        write_points(path, points, self._phantom.names)
        return path
