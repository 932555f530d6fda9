"""Reconstructing a sweep, and comparing modes over many."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

import speckle3d as s3
from speckle3d.cli.common import (
    Drift,
    Json,
    MaybePath,
    MaybeText,
    Out,
    Paths,
    Reference,
    Sweeps,
    WritablePath,
    emit,
    mount,
    note,
    part_of,
)
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.extras import require_extra

_SIGNS = {
    "truth": "that of the simulation's truth",
    "assumed": "not told by anything: taken as positive (setting sensors.direction)",
}


def reconstruct(
    sweep_file: Path,
    out: Out,
    curves_file: MaybePath = None,
    drift: list[Drift] | None = None,
    crossing_file: MaybePath = None,
    save_curves: Annotated[WritablePath, "curves"] = None,
    frames: MaybeText = None,
    crossing_frames: MaybeText = None,
    reference: Reference | None = None,
    region: MaybeText = None,
    drift_curves: Literal["published", "distance"] | None = None,
    volume: Annotated[WritablePath, "volume"] = None,
    calibration: Paths = None,
    config_file: MaybePath = None,
    as_json: Json = False,
) -> None:
    """Reconstruct a sweep: trajectory, drift-corrected trajectories, table, figures.

    Parameters
    ----------
    sweep_file
        Sweep to reconstruct: a file or folder of any known format.
    out
        Folder for the results.
    curves_file
    drift
        Mode beside image: orientation, pose (by those sensors), crossed (by a second sweep), fused (by all
        there is), consistent-subset (images without patches that the sensed orientation contradicts); may be
        repeated.
    crossing_file
        Second sweep over the same tissue, turned by 30 to 90 degrees.
    calibration
    volume
        Write a volume, too (.nrrd, .mha, .nii.gz, .nii), as group `volume` of the settings says, at the poses
        of the mode that claims the smallest error of length.
    reference
        What to compare with.
    region
    as_json

    Other Parameters
    ----------------
    frames
        FIRST-LAST: reconstruct these frames of the recording only.
    crossing_frames
        FIRST-LAST: cross with these frames; of the same recording without --crossing.
    save_curves
        With --crossing or --crossing-frames: write the curves as the crossing sweep corrects them.
    drift_curves
        Correction cubic in time (published) or in distance (for reversals).
    config_file

    Examples
    --------
    $ speckle3d reconstruct data/phantom.h5 -o out --drift orientation --drift pose
    """
    from speckle3d.io.load import open_recording
    from speckle3d.study.posed import open_posed
    from speckle3d.study.scenes.voxels import write_voxels
    from speckle3d.tracking import curves_beside, trust_words

    settings = s3.load_config(config_file).with_choices(drift_curves=drift_curves, region=region)
    modes, calibrations = list[str](dict.fromkeys(drift or ())), calibration or ()
    recording = open_recording(sweep_file)
    sweep = recording.sweep
    note(*recording.notes)
    curves_path = curves_file or curves_beside(sweep_file)
    curves = s3.load_curves(curves_path)
    mount(sweep, calibrations)
    crossing = None
    if crossing_file is not None or crossing_frames is not None:
        whole = sweep if crossing_file is None else s3.load_sweep(crossing_file)
        crossing = part_of(whole, crossing_frames, "--crossing-frames"), crossing_file or sweep_file
        if not {"crossed", "fused"}.intersection(modes):
            modes.append("crossed")
    sweep = part_of(sweep, frames, "--frames")
    with s3.progress_bar(f"reconstructing {sweep_file.name}") as progress:
        result = s3.run_job(
            sweep, sweep_file, curves, out, modes, reference, settings, progress, calibrations, crossing
        )
    if curves_file is None:
        note(trust_words(curves_path, curves, settings.curves.same_probe))
    if as_json:
        emit((result.directory / "summary.json").read_text(encoding="utf-8"))
        note(*result.summary.lines)
    else:
        emit(result.table)
    _tell(result)
    note(f"{len(sweep)} frames in {result.seconds:.1f} s; results in {result.directory}")
    if save_curves is not None and result.curves is not None:
        s3.write_curves(save_curves, result.curves)
        note(f"curves corrected by the crossing sweep, for this probe: {save_curves}")
    if volume is not None:
        posed = open_posed(result.directory / "reconstruction.h5", None, sweep_file)
        note(*posed.notes())
        with s3.progress_bar(f"compounding {volume.name}"):
            report = write_voxels(posed, settings.volume, volume)
        note(report.line)
    for reason in result.summary.left_out.values():
        raise MismatchError(f"{reason}; the other modes' results are in {result.directory}")


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

    settings, paths = s3.load_config(config_file), sweeps or []
    table = ""
    with scheduler_for(scheduler, workers) as runner, s3.progress_bar("comparing") as bar:
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


def _tell(result: s3.JobResult) -> None:
    """Note on stderr what limits the results."""
    details = result.summary.details
    for line in details["flagged_frames"]:
        note(line)
    if 0 < result.summary.coverage < 1:
        note(f"compared over the {100 * result.summary.coverage:.0f} % of frames that have a reference")
    share = details["rejected_patch_share"]
    if share == share:
        note(
            f"{100 * share:.0f} % of patches contradict the sensed orientation: "
            "orientation, pose and consistent-subset leave them out"
        )
    if (sign := _SIGNS.get(details["direction_from"])) is not None:
        note(f"the sign of the elevational motion is {sign}")
