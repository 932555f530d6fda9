"""Points of wires in images, picked, moved and deleted with the mouse, and the calibration with them."""

from __future__ import annotations

import html
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import panel as pn
from bokeh.models import ColumnDataSource, PointDrawTool
from panel.viewable import Viewable

from calibration.detection.dots import dots_in_image
from calibration.points import Seen
from calibration.recording import Recording, choose_crossings
from speckle3d.app.folder import Folder
from speckle3d.app.phantom.frames import FrameChoice
from speckle3d.app.phantom.options import Options
from speckle3d.app.phantom.picks import Picks
from speckle3d.app.phantom.picture import DROPPED, FOUND, USED, Picture
from speckle3d.app.phantom.region import Region
from speckle3d.app.phantom.run import RunPane, Solved, labelled
from speckle3d.app.phantom.work import Work, in_turn
from speckle3d.calibrating.phantoms import Wired, found, picked
from speckle3d.calibrating.settings import ScanSettings, WireSettings, with_values
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, Speckle3DError
from speckle3d.core.progress import Progress
from speckle3d.io.points import PickedPoints, read_points, write_points

_WIDTH, _HEIGHT = 590, 410
_NO_POINTS: dict[str, list[Any]] = {"column": [], "row": [], "wire": []}


class PointsPage:
    """Dots of wires, or places where wires cross, in the frames of a recording.

    Parameters
    ----------
    recording : Recording
        As from `speckle3d.calibrating.recordings.open_recording`.
    images : Path
        Its file, as the command is given it.
    folder : Folder
        Where points and results are saved.
    settings : WireSettings
        To begin with; its points are what the page begins with.

    Raises
    ------
    FileError, InvalidInputError
        If the phantom or the points cannot be read, or do not fit the recording.
    """

    title = "Points"

    def __init__(self, recording: Recording, images: Path, folder: Folder, settings: WireSettings) -> None:
        self._recording, self._images, self._folder = recording, images, folder
        self._settings, self._wired = settings, Wired.of(settings.phantom)
        self._given = None if settings.points is None else read_points(settings.points, self._wired.names)
        if self._given is not None:
            self._given.require_inside(recording.images.shape)

    def view(self) -> Viewable:
        """Return the page of one viewer."""
        picks = Picks(self._wired.names)
        if (given := self._given) is not None:
            wires = np.zeros(len(given), int) if given.wire is None else given.wire
            picks.take(given.frame.tolist(), given.pixels.tolist(), wires.tolist())
        return _Picker(
            self._recording, self._images, self._folder, self._settings, self._wired, picks
        ).layout()


class _Picker:
    """What one viewer sees and has picked."""

    def __init__(
        self,
        recording: Recording,
        images: Path,
        folder: Folder,
        settings: WireSettings,
        wired: Wired,
        picks: Picks,
    ) -> None:
        self._recording, self._folder, self._wired = recording, folder, wired
        self._given, self._picks = settings, picks
        self._run_with, self._drawing = PickedPoints(np.zeros(0, int), np.zeros((0, 2))), False
        self._candidates: Seen | None = None
        self._proposed = ""
        self._picture = Picture(recording, _WIDTH, _HEIGHT)
        clip = wired.clip_px
        self._clip = None if clip is None else tuple((float(column), float(row)) for column, row in clip)
        self._region = Region(self._picture.plot, settings.region or self._clip, self._changed)
        self._frames = FrameChoice(
            recording.images.shape[0], _WIDTH, settings.leave_out, self._show, self._changed
        )
        self._options = Options(settings, self._changed)
        self._points = ColumnDataSource(_NO_POINTS, name="points")
        self._near = ColumnDataSource({"column": [], "row": []})
        self._draw_tools()
        self._wire = pn.widgets.Select(name="wire of the next point", options=[*wired.names], width=170)
        self._find = pn.widgets.Button(name="Find points in all frames", width=190, disabled=not wired.found)
        self._work = Work(self._find)
        self._clear = pn.widgets.Button(name="Clear this frame", width=130)
        self._told = pn.pane.HTML("", width=_WIDTH)
        self._name = pn.widgets.TextInput(value=f"{images.stem}-points.csv", width=460)
        self._save = pn.widgets.Button(name="Save points", width=110)
        self._saved = pn.pane.HTML("", width=600)
        self._run = RunPane(
            recording, images, folder, self.settings, self._take, self._solved, self._with_points
        )
        self._watch()
        self._show()

    def layout(self) -> Viewable:
        left = pn.Column(
            self._frames.slider, pn.pane.Bokeh(self._picture.plot), self._told, self._frames.below()
        )
        wires = [self._wire] if self._wired.names else []
        hint = pn.pane.HTML(
            "Click: add. Drag: move. Click a point and press Backspace: delete. "
            "Grey crosses: what detection sees.",
            width=600,
        )
        right = pn.Column(
            labelled("Points", hint, pn.Row(self._find, self._clear, *wires, self._work.bar)),
            self._region.controls(),
            pn.Row(self._save, self._name),
            self._saved,
            self._options.view(),
            self._run.view(),
        )
        return pn.Row(left, right)

    def settings(self) -> ScanSettings:
        """The settings as they stand on the page."""
        corners = self._region.corners
        # The configuration's own clip is what counts without a region.
        values = {"region": None if corners == self._clip else corners, "leave_out": self._frames.left_out}
        return with_values(self._given, self._options.values() | values)

    def _draw_tools(self) -> None:
        plot = self._picture.plot
        plot.scatter("column", "row", source=self._near, marker="cross", size=9, color="#bbbbbb")
        drawn = plot.scatter(
            "column", "row", source=self._points, size=11, line_color=FOUND, line_width=2, fill_alpha=0.0
        )
        plot.text(
            "column", "row", "wire", source=self._points, x_offset=8, y_offset=-4,
            text_color=FOUND, text_font_size="11px",
        )  # fmt: skip
        self._tool = PointDrawTool(
            renderers=[drawn],
            empty_value="",
            num_objects=0 if self._wired.names else 1,
            description="Points",
        )
        plot.add_tools(self._tool)
        plot.toolbar.active_tap = plot.toolbar.active_drag = self._tool

    def _watch(self) -> None:
        self._points.on_change("data", self._edited)
        self._wire.param.watch(in_turn(self._named), "value")
        self._find.on_click(in_turn(self._find_all))
        self._clear.on_click(in_turn(partial(self._put, [])))
        self._save.on_click(in_turn(self._save_points))

    def _changed(self) -> None:
        self._run.outdate()
        self._show()

    def _show(self) -> None:
        frame = self._frames.frame
        image = self._picture.show(frame)
        self._draw_points()
        self._next_wire()
        try:
            near = self._seen_in(image)
        except Speckle3DError as error:
            near = np.zeros((0, 2))
            self._tell(str(error), DROPPED)
        else:
            self._count()
        self._near.data = {"column": near[:, 0], "row": near[:, 1]}

    def _seen_in(self, image: npt.NDArray[Any]) -> FloatArray:
        """Places in this frame among which a search would choose, shape (n, 2)."""
        if self._candidates is not None:
            return np.asarray(self._candidates.pixels[self._candidates.frame == self._frames.frame])
        if not self._wired.names:
            return np.zeros((0, 2))
        pixels, _ = dots_in_image(image, self._recording.pixel_mm, self._region.corners)
        return pixels

    def _draw_points(self) -> None:
        points = self._picks.of(self._frames.frame)
        held = {name: [point[i] for point in points] for i, name in enumerate(_NO_POINTS)}
        self._drawing = True
        try:
            self._points.data = held
        finally:
            self._drawing = False

    def _edited(self, attribute: str, old: object, new: Any) -> None:
        if self._drawing:
            return
        rows = zip(new["column"], new["row"], new["wire"], strict=True)
        self._put([(float(column), float(row), str(wire)) for column, row, wire in rows])

    def _put(self, points: list[tuple[float, float, str]]) -> None:
        self._picks.put(self._frames.frame, points)
        self._run.outdate()
        self._draw_points()
        self._next_wire()
        self._count()

    def _next_wire(self) -> None:
        missing = self._picks.missing(self._frames.frame)
        if missing and self._wire.value not in missing:
            self._proposed = self._wire.value = missing[0]
        self._tool.default_overrides = {"wire": self._wire.value or ""}

    def _named(self) -> None:
        """The wire of the next point, or of the one that is selected."""
        name = self._wire.value or ""
        self._tool.default_overrides = {"wire": name}
        if name == self._proposed:
            return
        self._proposed = ""
        chosen = list(self._points.selected.indices)
        points = self._picks.of(self._frames.frame)
        if len(chosen) == 1 and chosen[0] < len(points):
            column, row, _ = points.pop(chosen[0])
            self._points.selected.indices = []
            self._put([*points, (column, row, name)])

    def _count(self) -> None:
        frame, frames = self._frames.frame, len(self._picks.frames)
        here, missing = len(self._picks.of(frame)), self._picks.missing(frame)
        lacking = f"; none on {', '.join(missing)}" if here and missing else ""
        self._tell(f"frame {frame}: {here} points{lacking}; {len(self._picks)} in {frames} frames", USED)
        self._frames.strip.picked(self._picks.frames)

    def _tell(self, words: str, colour: str) -> None:
        self._told.object = f"<span class='points-told' style='color:{colour}'>{html.escape(words)}</span>"

    def _find_all(self) -> None:
        try:
            settings = self.settings()
        except Speckle3DError as error:
            self._tell(str(error), DROPPED)
            return
        self._tell("finding points in all frames ...", USED)
        self._work.start(partial(self._search, settings), lambda found: self._searched(*found))

    def _search(self, settings: ScanSettings, progress: Progress) -> tuple[Seen | None, Seen | None, str]:
        """Candidates, those of them that are chosen, and why there are none."""
        try:
            seen = found(self._recording, settings, None, progress)
            if self._wired.names:
                return None, seen, ""
            return seen, choose_crossings(self._recording, seen, [self._recording.time_offset_s]), ""
        except InsufficientDataError as error:
            return None, None, str(error)

    def _searched(self, candidates: Seen | None, chosen: Seen | None, refusal: str) -> None:
        if chosen is None:
            self._tell(refusal, DROPPED)
            return
        self._candidates = candidates
        self._picks.take_seen(chosen)
        self._changed()

    def _save_points(self) -> None:
        try:
            path = self._write(self._name.value or "", self._picks.points())
        except Speckle3DError as error:
            self._saved.object = f"<span style='color:{DROPPED}'>{html.escape(str(error))}</span>"
            return
        self._saved.object = f"<span style='color:{USED}'>Saved {html.escape(str(path))}</span>"

    def _write(self, name: str, points: PickedPoints) -> Path:
        if not len(points):
            raise InvalidInputError("expected points to save, got none")
        if not name.endswith(".csv"):
            name += ".csv"
        return self._folder.save(name, lambda path: write_points(path, points, self._wired.names))

    def _take(self, settings: ScanSettings, progress: Progress) -> Seen:
        self._run_with = self._picks.points()
        if not len(self._run_with):
            raise InvalidInputError("expected points: find them, or click where they are")
        return picked(self._recording, self._run_with, settings)

    def _with_points(self, settings: ScanSettings, out: Path) -> ScanSettings:
        """Save the points that a calibration was made from, for the command to be given them."""
        points = self._write(f"{out.stem}-points.csv", self._run_with)
        return with_values(settings, {"points": points})

    def _solved(self, run: Solved) -> None:
        self._frames.strip.tell(run.seen, run.outcome)
