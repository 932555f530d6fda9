"""Comparing drift-correction modes over many sweeps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.common import CalibrationFiles, ConfigFile, Json, app, emit, load_settings, note
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.extras import require_extra
from speckle3d.core.progress import bar_on_stderr

if TYPE_CHECKING:
    from speckle3d.study.compare import StudyProgress
    from speckle3d.study.results import Study


@app.command()
def compare(
    sweeps: Annotated[
        list[Path] | None, typer.Argument(metavar="SWEEP...", help="Sweeps to compare modes on.")
    ] = None,
    *,
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for the study.")],
    drift: Annotated[
        list[str] | None,
        typer.Option(
            help="consistent-subset, orientation, pose, fused, or crossed with SWEEP-crossing beside each "
            "sweep; may be repeated. By default all but the last that are possible."
        ),
    ] = None,
    reference: Annotated[str | None, typer.Option(help="What to compare with: tracker or truth.")] = None,
    curves_file: Annotated[
        Path | None,
        typer.Option("--curves", help="Decorrelation curves; by default curves.h5 beside each sweep."),
    ] = None,
    calibration: CalibrationFiles = None,
    config_file: ConfigFile = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, as tcp://host:8786, to run on.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Run in so many processes on this machine, instead of in one.")
    ] = None,
    paper: Annotated[
        bool,
        typer.Option("--paper", help="The eleven sweeps of Housden 2008, simulated; tables beside theirs."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Compare drift-correction modes over sweeps with a reference: tables, curves, a report.

    A sweep that fails is a row that says why; the exit code is 2 only if all do.
    """
    require_extra("report", "compare", "plotly")
    from speckle3d.report.page import write_report
    from speckle3d.study.compare import compare_sweeps
    from speckle3d.study.paper import paper_study
    from speckle3d.study.schedulers import scheduler_for

    settings = load_settings(config_file)
    if not (paper or sweeps):
        raise InvalidInputError("expected sweeps to compare, or --paper, got neither")
    fixed = {"sweeps": sweeps, "drift": drift, "reference": reference, "calibration": calibration}
    for name, value in (fixed | {"config": config_file}).items():
        if paper and value:
            raise InvalidInputError(f"--paper: expected no {name}, which the study fixes, got {value}")
    table = ""
    with scheduler_for(scheduler, workers) as where, _shown() as progress:
        if paper:
            study, table = paper_study(
                out, curves_file, where, progress, lambda n, total: note(f"{n} of {total} sweeps simulated")
            )
        else:
            study = compare_sweeps(
                sweeps or [], out, drift, reference, curves_file, settings, calibration or (), where, progress
            )
    write_report(out)
    emit((out / "study.json").read_text(encoding="utf-8") if as_json else table or study.table)
    _tell(study)


def _tell(study: Study) -> None:
    """Say on stderr what became of the sweeps; fail if all did."""
    failed = [each for each in study.outcomes if each.status == "failed"]
    skipped = sum(each.skipped for each in study.outcomes)
    if skipped:
        note(f"{skipped} of {len(study.outcomes)} sweeps were finished before and are taken as they are")
    for each in failed:
        note(f"{each.name}: failed: {each.reason}")
    out = study.directory
    note(f"results in {out}; the report is {out / 'report.html'}")
    if len(failed) == len(study.outcomes):
        raise InsufficientDataError(f"{out}: expected a sweep that can be compared, got none")


@contextmanager
def _shown() -> Iterator[Callable[[StudyProgress], None]]:
    """Sweeps done and the time that is left, on stderr; nothing in a log."""
    from rich.progress import TextColumn

    with bar_on_stderr("comparing", TextColumn("{task.description}")) as bar:
        task = bar.add_task("", total=None)

        def show(at: StudyProgress) -> None:
            bar.update(task, completed=at.done_frames, total=at.frames, description=_line(at))

        yield show


def _line(at: StudyProgress) -> str:
    failed = f", {at.failed} failed" if at.failed else ""
    left = "time left is known after the first"
    if at.remaining_s is not None:
        minutes, seconds = divmod(round(at.remaining_s), 60)
        left = f"about {minutes} min {seconds:02d} s left"
    return f"{at.done} of {at.sweeps} sweeps{failed}; {left}"
