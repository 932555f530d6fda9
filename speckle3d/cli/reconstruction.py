"""Reconstructing a sweep."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.calibrations import mount
from speckle3d.cli.common import CalibrationFiles, ConfigFile, Json, app, emit, load_settings, note
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from collections.abc import Sequence

    from speckle3d.config import Config
    from speckle3d.core.sweep import Sweep
    from speckle3d.study.job import JobResult


@app.command()
def reconstruct(
    sweep_file: Annotated[
        Path,
        typer.Argument(metavar="SWEEP", help="Sweep to reconstruct: a file or folder of any known format."),
    ],
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")],
    curves_file: Annotated[
        Path | None, typer.Option("--curves", help="Decorrelation curves; by default curves.h5 beside SWEEP.")
    ] = None,
    drift: Annotated[
        list[str] | None,
        typer.Option(
            help="Correction mode: orientation, pose, fused, crossed or consistent-subset; may be repeated."
        ),
    ] = None,
    crossing_file: Annotated[
        Path | None,
        typer.Option("--crossing", help="Second sweep over the same tissue, turned by 30 to 90 degrees."),
    ] = None,
    save_curves: Annotated[
        Path | None, typer.Option(help="Write the curves as the crossing sweep corrects them.")
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="FIRST-LAST: reconstruct these frames of the recording only.")
    ] = None,
    crossing_frames: Annotated[
        str | None,
        typer.Option(help="FIRST-LAST: cross with these frames; of the same recording without --crossing."),
    ] = None,
    reference: Annotated[str | None, typer.Option(help="What to compare with: tracker or truth.")] = None,
    consistent_subset: Annotated[
        bool | None,
        typer.Option(help="In mode orientation, drop distances that the sensed orientation contradicts."),
    ] = None,
    drift_curves: Annotated[
        str | None, typer.Option(help="Correction cubic in time (published) or in distance (for reversals).")
    ] = None,
    volume: Annotated[
        Path | None,
        typer.Option(
            help="Write a volume, too (.nrrd, .mha, .nii.gz, .nii), as group `volume` of the settings says."
        ),
    ] = None,
    volume_mode: Annotated[
        str | None,
        typer.Option(
            help="Poses of the volume; by default the first there is of fused, crossed, pose, orientation, "
            "image."
        ),
    ] = None,
    calibration: CalibrationFiles = None,
    config_file: ConfigFile = None,
    as_json: Json = False,
) -> None:
    """Reconstruct a sweep: trajectory, drift-corrected trajectories, table, figures."""
    from speckle3d.io.curves import read_curves, write_curves
    from speckle3d.io.load import load_sweep
    from speckle3d.io.sweeps import unfinished_note
    from speckle3d.io.voxels.volume_writer import require_suffix
    from speckle3d.study.job import run_job

    settings = load_settings(config_file).with_choices(
        consistent_subset=consistent_subset, drift_curves=drift_curves
    )
    modes = list(dict.fromkeys(drift or ()))
    sweep = load_sweep(sweep_file)
    if (unfinished := unfinished_note(sweep_file)) is not None:
        note(unfinished)
    used = _find_curves(curves_file, sweep_file)
    curves = read_curves(used)
    mount(sweep, calibration or ())
    crossing = _crossing(sweep, sweep_file, crossing_file, crossing_frames)
    if crossing is not None and not {"crossed", "fused"}.intersection(modes):
        modes.append("crossed")
    if save_curves is not None:
        if crossing is None:
            raise InvalidInputError("--save-curves: expected a crossing sweep (--crossing SWEEP), got none")
        read = (sweep_file, crossing[1], config_file, used, *(calibration or ()))
        require_own_place(save_curves, "curves", *read)
    if volume is not None:
        require_suffix(volume)
        # In a folder of results that is still to be made nothing can be in the way.
        if volume.parent.exists() or volume.parent != out:
            require_own_place(volume, "volume", sweep_file, crossing_file, used, *(calibration or ()))
        _require_mode(volume_mode, modes)
    elif volume_mode is not None:
        raise InvalidInputError("--volume-mode: expected --volume beside it, got none")
    sweep = _part(sweep, frames, "--frames")
    with progress_bar(f"reconstructing {sweep_file.name}") as progress:
        result = run_job(
            sweep, sweep_file, curves, out, modes, reference, settings, progress, calibration or (), crossing
        )
    if save_curves is not None and result.curves is not None:
        write_curves(save_curves, result.curves)
    if as_json:
        emit((result.directory / "summary.json").read_text(encoding="utf-8"))
        for line in result.summary.doubt_lines:
            note(line)
    else:
        emit(result.table)
    _tell(result)
    note(f"{len(sweep)} frames in {result.seconds:.1f} s; results in {result.directory}")
    if volume is not None:
        _write_volume(result, sweep_file, volume, volume_mode, settings)
    if save_curves is not None:
        note(
            f"curves corrected by the crossing sweep, for this probe: {save_curves}"
            if result.curves is not None
            else f"{save_curves}: not written, since the sweeps could not be crossed"
        )
    for reason in result.summary.left_out.values():
        raise MismatchError(f"{reason}; the other modes' results are in {result.directory}")


def _require_mode(wanted: str | None, modes: Sequence[str]) -> None:
    if wanted is not None and wanted not in ("image", *modes):
        there = ", ".join(("image", *modes))
        raise InvalidInputError(f"--volume-mode: expected one of {there}, as --drift has it, got {wanted!r}")


def _write_volume(result: JobResult, sweep_file: Path, out: Path, mode: str | None, settings: Config) -> None:
    """Compound the sweep at the poses just found."""
    from speckle3d.study.posed import open_posed
    from speckle3d.study.scenes.voxels import VolumeRequest, best_mode, write_voxels

    made = result.directory / "reconstruction.h5"
    posed = open_posed(made, mode or best_mode(made), sweep_file)
    with progress_bar(f"compounding {out.name}") as progress:
        note(write_voxels(posed, VolumeRequest(out, settings.volume), progress).line)


def _crossing(
    sweep: Sweep, sweep_file: Path, crossing_file: Path | None, frames: str | None
) -> tuple[Sweep, Path] | None:
    """The crossing sweep and its file: another recording, or a part of the same one; None without either."""
    from speckle3d.io.load import load_sweep

    if crossing_file is None and frames is None:
        return None
    whole = sweep if crossing_file is None else load_sweep(crossing_file)
    return _part(whole, frames, "--crossing-frames"), crossing_file or sweep_file


def _part(sweep: Sweep, frames: str | None, option: str) -> Sweep:
    if frames is None:
        return sweep
    first, dash, last = frames.partition("-")
    if not (dash and first.isdecimal() and last.isdecimal()):
        raise InvalidInputError(f"{option}: expected FIRST-LAST, two frame numbers, got {frames!r}")
    return sweep.part(int(first), int(last) + 1)


def _tell(result: JobResult) -> None:
    """Say on stderr what limits the results."""
    details = result.summary.details
    for line in details["flagged_frames"]:
        note(f"{line}: poses there are guesses")
    if 0 < result.summary.coverage < 1:
        note(f"compared over the {100 * result.summary.coverage:.0f} % of frames that have a reference")
    rejected = details["rejected_patch_share"]
    if rejected == rejected:
        note(f"{100 * rejected:.0f} % of patches contradict the sensed orientation and were left out")
    if details["direction_from"] == "truth":
        note("the sign of the elevational motion was taken from the simulation's truth")
    if details["direction_from"] == "assumed":
        note(
            "nothing tells the sign of the elevational motion: taken as positive (setting sensors.direction)"
        )


def _find_curves(given: Path | None, sweep_file: Path) -> Path:
    if given is not None:
        return given
    beside = sweep_file.parent / "curves.h5"
    if not beside.is_file():
        raise InvalidInputError(
            f"expected decorrelation curves: --curves CURVES.h5 or {beside}, got neither "
            "(speckle3d calibrate curves makes them from a phantom sweep)"
        )
    note(f"curves: {beside}")
    return beside
