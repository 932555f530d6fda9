"""Run a calibration from a page: progress, the verdict and what is missing, and saving the result."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import panel as pn
from panel.viewable import Viewable

from calibration.points import Seen
from calibration.recording import Outcome, Recording
from calibration.report import text_report
from speckle3d.app.folder import Folder
from speckle3d.app.phantom.picture import DROPPED, USED
from speckle3d.app.phantom.work import Work, in_turn
from speckle3d.calibrating.phantoms import remarks, solved, write_outcome
from speckle3d.calibrating.settings import ScanSettings
from speckle3d.calibrating.written import BESIDE
from speckle3d.core.errors import Speckle3DError
from speckle3d.core.progress import Progress

_LACKING = "#9a6700"
"""Dark amber: a result that more motion would improve."""
_TABLE = "margin:0;font-size:12px;line-height:1.35"

Finder = Callable[[ScanSettings, Progress], Seen]


@dataclass(frozen=True)
class Solved:
    """A calibration with the settings that made it.

    Attributes
    ----------
    seen : Seen, optional
        What was found in the images, as far as it came.
    lacking : bool
        Whether the verdict names motions that are missing.
    refusal : str
        Without an outcome, why.
    """

    settings: ScanSettings
    seen: Seen | None = None
    outcome: Outcome | None = None
    lacking: bool = False
    refusal: str = ""


class RunPane:
    """The button that calibrates, what came of it, and where it is saved.

    Parameters
    ----------
    images : Path
        Of the recording, as the command is given it.
    settings : callable
        Returns the settings as they stand; raises `Speckle3DError` if they are none.
    find : callable
        Finds the phantom in the images; called in a thread.
    done : callable
        Called with what came of a run.
    before_saving : callable, optional
        Brings the settings of a run, whose calibration goes to a path, into what a command can be given,
        as by saving points picked by hand.
    """

    def __init__(
        self,
        recording: Recording,
        images: Path,
        folder: Folder,
        settings: Callable[[], ScanSettings],
        find: Finder,
        done: Callable[[Solved], None],
        before_saving: Callable[[ScanSettings, Path], ScanSettings] = lambda settings, out: settings,
    ) -> None:
        self._recording, self._images, self._folder = recording, images, folder
        self._settings, self._find, self._done = settings, find, done
        self._before_saving = before_saving
        self._solved: Solved | None = None
        self.button = pn.widgets.Button(name="Run calibration", button_type="primary", width=150)
        self._work = Work(self.button)
        self._verdict = pn.pane.HTML(_told("Not calibrated yet.", "#555555"), width=600)
        self._table = pn.pane.HTML("", width=600, max_height=300, styles={"overflow-y": "auto"})
        self._name = pn.widgets.TextInput(name="", value=f"{images.stem}-calibration.h5", width=460)
        self._save = pn.widgets.Button(name="Save result", width=110, disabled=True)
        self._saved = pn.pane.HTML("", width=600)
        self.button.on_click(in_turn(self._run))
        self._save.on_click(in_turn(self._write))

    def view(self) -> Viewable:
        """The button, the verdict, saving, and the table."""
        return pn.Column(
            pn.Row(self.button, self._work.bar),
            self._verdict,
            pn.Row(self._save, self._name),
            self._saved,
            # Last, so that what is told of saving is seen without scrolling.
            self._table,
        )

    def outdate(self) -> None:
        """Say that the result shown is of other settings than those that stand now; it cannot be saved."""
        if self._solved is None or self._save.disabled:
            return
        self._save.disabled = True
        words = "Settings changed since this result: run again."
        self._verdict.object = _told(words, DROPPED) + self._verdict.object

    def _run(self) -> None:
        try:
            settings = self._settings()
        except Speckle3DError as error:
            self._verdict.object = _told(str(error), DROPPED)
            return
        self._work.start(partial(self._solve, settings), self._show)

    def _solve(self, settings: ScanSettings, progress: Progress) -> Solved:
        seen = None
        try:
            seen = self._find(settings, progress)
            outcome = solved(self._recording, seen, settings)
            return Solved(settings, seen, outcome, bool(outcome.solution.adequacy.missing))
        except Speckle3DError as error:
            return Solved(settings, seen, refusal=str(error))

    def _show(self, found: Solved) -> None:
        self._solved, self._saved.object = found, ""
        if found.outcome is None:
            self._verdict.object = _told(f"No calibration: {found.refusal}", DROPPED)
            self._table.object = ""
        else:
            calibration = found.outcome.calibration
            self._verdict.object = _told(calibration.verdict, _LACKING if found.lacking else USED)
            table = text_report(calibration, found.outcome.beam, remarks(found.outcome))
            self._table.object = f"<pre class='calibration' style='{_TABLE}'>{html.escape(table)}</pre>"
        self._save.disabled = found.outcome is None
        self._done(found)

    def _write(self) -> None:
        found = self._solved
        if found is None or found.outcome is None:
            return
        try:
            written = self._written(found.outcome, found.settings, self._name.value or "")
        except Speckle3DError as error:
            self._saved.object = _told(str(error), DROPPED)
            return
        names = ", ".join(path.name for path in written)
        self._saved.object = _told(f"Saved {names} in {self._folder.path}", USED)

    def _written(self, outcome: Outcome, settings: ScanSettings, name: str) -> tuple[Path, ...]:
        out = self._folder.place(name)
        if out.suffix != ".h5":
            self._folder.place(f"{name}.h5")
            out = out.with_name(f"{name}.h5")
        for suffix in BESIDE:
            self._folder.place(out.with_suffix(suffix).name)
        settings = self._before_saving(settings, out)
        return write_outcome(outcome, settings, self._images, out, remarks(outcome)).files


def _told(words: str, colour: str) -> str:
    return f"<div class='verdict' style='color:{colour};font-weight:600'>{html.escape(words)}</div>"


def labelled(words: str, *held: Any) -> Viewable:
    """A group of widgets under a heading."""
    return pn.Column(pn.pane.HTML(f"<b>{html.escape(words)}</b>", margin=(4, 8, 0, 8)), *held)
