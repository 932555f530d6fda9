"""Run a calibration from a page: progress, the verdict and what is missing, and saving the result."""

from __future__ import annotations

import html
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import panel as pn
from panel.viewable import Viewable

from calibration.points import Recording, Seen
from calibration.recording import Outcome
from calibration.report import text_report
from speckle3d.app.folder import Folder
from speckle3d.app.phantom.plots import DROPPED, USED
from speckle3d.calibrating.phantoms import remarks, solved, write_outcome
from speckle3d.calibrating.settings import ScanSettings
from speckle3d.calibrating.written import BESIDE
from speckle3d.core.errors import Speckle3DError

_LACKING = "#9a6700"
"""Dark amber: a result that more motion would improve."""
_POLL_MS = 100
_POOL = ThreadPoolExecutor(2, "speckle3d-calibration")


class Work:
    """A button whose work runs in a thread, and which turns and cannot be clicked meanwhile.

    Parameters
    ----------
    name : str
        Of the button.
    """

    def __init__(self, name: str, **look: Any) -> None:
        self.button = pn.widgets.Button(name=name, **look)

    def start(self, work: Callable[[], Any], ended: Callable[[Any], None]) -> None:
        """Do the work, then show its result."""
        self.button.disabled = self.button.loading = True
        self._clock = pn.state.add_periodic_callback(partial(self._look, _POOL.submit(work), ended), _POLL_MS)

    def _look(self, future: Future[Any], ended: Callable[[Any], None]) -> None:
        if future.done():
            self._clock.stop()
            self.button.disabled = self.button.loading = False
            ended(future.result())


@dataclass(frozen=True)
class Solved:
    """A calibration with the settings that made it.

    Attributes
    ----------
    seen : Seen, optional
        What was found in the images, as far as it came.
    refusal : str
        Without an outcome, why.
    """

    settings: ScanSettings
    seen: Seen | None = None
    outcome: Outcome | None = None
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
    before_saving : callable
        Brings the settings of a run, whose calibration goes to a path, into what a command can be given, as
        by saving points picked by hand.
    """

    def __init__(
        self,
        recording: Recording,
        images: Path,
        folder: Folder,
        settings: Callable[[], ScanSettings],
        find: Callable[[ScanSettings], Seen],
        done: Callable[[Solved], None],
        before_saving: Callable[[ScanSettings, Path], ScanSettings],
    ) -> None:
        self._recording, self._images, self._folder = recording, images, folder
        self._settings, self._find, self._done = settings, find, done
        self._before_saving = before_saving
        self._solved: Solved | None = None
        self._work = Work("Run calibration", button_type="primary", width=150)
        self._verdict = pn.pane.HTML(sentence("Not calibrated yet.", "#555555"), width=600)
        self._table = pn.pane.HTML("", width=600)
        self._name = pn.widgets.TextInput(
            name="file of the result", value=f"{images.stem}-calibration.h5", width=460
        )
        self._save = pn.widgets.Button(name="Save result", width=110, disabled=True, align="end")
        self._saved = pn.pane.HTML("", width=600)
        self._work.button.on_click(self._run)
        self._save.on_click(self._write)

    def view(self) -> Viewable:
        """The button, the verdict, saving, and the table."""
        return pn.Column(
            self._work.button,
            self._verdict,
            pn.Row(self._save, self._name),
            self._saved,
            self._table,
        )

    def outdate(self) -> None:
        """Say that the result shown is of other settings than those that stand now; it cannot be saved."""
        if not self._save.disabled:
            self._save.disabled = True
            words = "Settings changed since this result: run again."
            self._verdict.object = sentence(words, DROPPED) + self._verdict.object

    def _run(self, _: object) -> None:
        try:
            settings = self._settings()
        except Speckle3DError as error:
            self._verdict.object = sentence(str(error), DROPPED)
            return
        self._work.start(partial(self._solve, settings), self._show)

    def _solve(self, settings: ScanSettings) -> Solved:
        seen = None
        try:
            seen = self._find(settings)
            return Solved(settings, seen, solved(self._recording, seen, settings))
        except Speckle3DError as error:
            return Solved(settings, seen, refusal=str(error))

    def _show(self, run: Solved) -> None:
        self._solved, self._saved.object, self._save.disabled = run, "", run.outcome is None
        if run.outcome is None:
            self._verdict.object, self._table.object = sentence(f"No calibration: {run.refusal}", DROPPED), ""
        else:
            calibration, lacking = run.outcome.calibration, run.outcome.solution.adequacy.missing
            self._verdict.object = sentence(calibration.verdict, _LACKING if lacking else USED)
            table = text_report(calibration, run.outcome.beam, remarks(run.outcome))
            self._table.object = f"<pre class='calibration' style='margin:0'>{html.escape(table)}</pre>"
        self._done(run)

    def _write(self, _: object) -> None:
        run, name = self._solved, self._name.value or ""
        if run is None or run.outcome is None:
            return
        try:
            out = self._folder.place(name if name.endswith(".h5") else f"{name}.h5")
            for suffix in BESIDE:
                self._folder.place(out.with_suffix(suffix).name)
            settings = self._before_saving(run.settings, out)
            files = write_outcome(run.outcome, settings, self._images, out, remarks(run.outcome)).files
        except Speckle3DError as error:
            self._saved.object = sentence(str(error), DROPPED)
            return
        self._saved.object = sentence(
            f"Saved {', '.join(path.name for path in files)} in {self._folder.path}", USED
        )


def sentence(words: str, colour: str, name: str = "verdict") -> str:
    """HTML of a sentence."""
    return f"<div class='{name}' style='color:{colour};font-weight:600'>{html.escape(words)}</div>"
