"""Comparing drift-correction modes over many sweeps."""

from __future__ import annotations

from typing import Annotated

import typer

from speckle3d.cli.common import (
    Drift,
    Json,
    MaybePath,
    MaybeText,
    Out,
    Paths,
    Reference,
    Sweeps,
    emit,
    load_settings,
    note,
)
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.extras import require_extra
from speckle3d.core.progress import progress_bar


def compare(
    out: Out,
    sweeps: Sweeps = None,
    drift: list[Drift] | None = None,
    reference: Reference | None = None,
    curves_file: MaybePath = None,
    calibration: Paths = None,
    config_file: MaybePath = None,
    scheduler: MaybeText = None,
    workers: Annotated[int | None, typer.Option(min=1)] = None,
    paper: bool = False,
    as_json: Json = False,
) -> None:
    """Compare drift-correction modes over sweeps with a reference: tables, curves, a report.

    One of SWEEPS or --paper. A sweep that fails is a row that says why; the exit code is 2 only if all do.

    Parameters
    ----------
    sweeps
        Sweeps to compare modes on.
    out
        Folder for the study.
    drift
        Mode; crossed needs SWEEP-crossing beside each sweep; may be repeated. By default all but crossed that
        are possible.
    reference
        What to compare with.
    curves_file, workers, as_json

    Other Parameters
    ----------------
    paper
        The eleven sweeps of Housden 2008, simulated; tables beside theirs. With --curves: of that probe, as
        data/curves.h5. Not with --drift or --reference or --calibration or --config.
    workers
        Run in so many processes on this machine, instead of in one.
    scheduler
        Address of a Dask scheduler, as tcp://host:8786, to run on. Not with --workers.
    calibration, config_file

    Examples
    --------
    $ speckle3d compare a.h5 b.h5 -o study
    """
    require_extra("report", "compare", "plotly")
    from speckle3d.report.page import write_report
    from speckle3d.study.compare import compare_sweeps
    from speckle3d.study.paper import paper_study
    from speckle3d.study.schedulers import scheduler_for

    settings, paths = load_settings(config_file), sweeps or []
    table = ""
    with scheduler_for(scheduler, workers) as runner, progress_bar("comparing") as bar:
        if curves_file is not None and paper:
            study, table = paper_study(
                out, curves_file, runner, bar, lambda n, total: note(f"{n} of {total} sweeps simulated")
            )
        else:
            study = compare_sweeps(
                paths, out, drift, reference, curves_file, settings, calibration or (), runner, bar
            )
    write_report(study)
    if old := sum(outcome.is_old for outcome in study.outcomes):
        note(f"{old} of {len(study.outcomes)} sweeps were finished before and are taken as they are")
    for outcome in study.failures:
        note(f"{outcome.name}: failed: {outcome.reason}")
    note(f"results in {out}; the report is {out / 'report.html'}")
    emit((out / "study.json").read_text(encoding="utf-8") if as_json else table or study.table)
    if not study.successes:
        raise InsufficientDataError(f"{out}: expected a sweep that can be compared, got none")
