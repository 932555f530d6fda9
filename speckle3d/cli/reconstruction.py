"""Reconstructing a sweep, and looking at what was reconstructed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.calibrations import mount
from speckle3d.cli.common import (
    CalibrationFiles,
    ConfigFile,
    Json,
    app,
    emit,
    load_settings,
    note,
    progress_bar,
)
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError, MismatchError

if TYPE_CHECKING:
    from speckle3d.core.sweep import Sweep
    from speckle3d.study.job import JobResult

ReconstructionFile = Annotated[
    Path,
    typer.Argument(metavar="RECONSTRUCTION", help="reconstruction.h5 of a results folder."),
]
Mode = Annotated[
    str, typer.Option(help="Which poses to use: image, orientation, pose, crossed, inertial, fused.")
]
SweepFile = Annotated[
    Path | None, typer.Option("--sweep", help="The sweep, if it moved since the reconstruction.")
]
DynamicRange = Annotated[float, typer.Option(help="Range of the log-compressed grey levels.")]


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
            help="Correction mode: orientation, pose, fused, inertial, crossed or image+subset; repeatable."
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
    calibration: CalibrationFiles = None,
    config_file: ConfigFile = None,
    as_json: Json = False,
) -> None:
    """Reconstruct a sweep: trajectory, drift-corrected trajectories, table, figures."""
    from speckle3d.io.curves import read_curves, write_curves
    from speckle3d.io.load import load_sweep
    from speckle3d.study.job import run_job

    settings = load_settings(config_file).with_choices(
        consistent_subset=consistent_subset, drift_curves=drift_curves
    )
    modes = list(dict.fromkeys(drift or ()))
    sweep = load_sweep(sweep_file)
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
    if save_curves is not None:
        note(
            f"curves corrected by the crossing sweep, for this probe: {save_curves}"
            if result.curves is not None
            else f"{save_curves}: not written, since the sweeps could not be crossed"
        )
    for reason in result.summary.left_out.values():
        raise MismatchError(f"{reason}; the other modes' results are in {result.directory}")


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


@app.command()
def volume(
    reconstruction_file: ReconstructionFile,
    out: Annotated[Path, typer.Option("-o", "--output", help="VOLUME.nrrd, .mha or .nii.gz to write.")],
    mode: Mode = "image",
    voxel_mm: Annotated[float, typer.Option(help="Side of a voxel.")] = 0.2,
    sweep_file: SweepFile = None,
    dynamic_range_db: DynamicRange = 60.0,
) -> None:
    """Compound the frames into voxels, at the poses of one mode."""
    from speckle3d.imaging.volume import compound
    from speckle3d.io.volumes import write_volume
    from speckle3d.scoring.trajectories import poses_of
    from speckle3d.study.images import grey_images, open_reconstruction

    require_own_place(out, "volume", reconstruction_file, sweep_file)
    reconstruction, sweep = open_reconstruction(reconstruction_file, sweep_file)
    with progress_bar(f"compounding {out.name}") as progress:
        images = grey_images(sweep, dynamic_range_db, progress, reconstruction)
        voxels = compound(images, images.grid, poses_of(reconstruction, mode), voxel_mm, voxel_type="uint8")
    write_volume(out, voxels)


@app.command()
def reslice(
    reconstruction_file: ReconstructionFile,
    out: Annotated[Path, typer.Option("-o", "--output", help="PNG to write.")],
    mode: Mode = "image",
    lateral_mm: Annotated[
        float | None, typer.Option(help="Cut along the sweep at this lateral position (middle).")
    ] = None,
    depth_mm: Annotated[float | None, typer.Option(help="Cut parallel to the skin at this depth.")] = None,
    reach_mm: Annotated[float, typer.Option(help="Frames farther from a pixel do not count.")] = 0.5,
    sweep_file: SweepFile = None,
    dynamic_range_db: DynamicRange = 60.0,
) -> None:
    """Cut a plane straight from the frames, at the poses of one mode."""
    from speckle3d.imaging.reslice import along_sweep_plane, reslice_frames, surface_plane
    from speckle3d.scoring.trajectories import poses_of
    from speckle3d.study.figures import figure_reslice, save_figure
    from speckle3d.study.images import grey_images, open_reconstruction

    if lateral_mm is not None and depth_mm is not None:
        raise InvalidInputError("expected --lateral-mm or --depth-mm, got both")
    require_own_place(out, "picture", reconstruction_file, sweep_file)
    reconstruction, sweep = open_reconstruction(reconstruction_file, sweep_file)
    poses = poses_of(reconstruction, mode)
    with progress_bar(f"reslicing {out.name}") as progress:
        images = grey_images(sweep, dynamic_range_db, progress, reconstruction)
        if depth_mm is not None:
            plane = surface_plane(poses, images.grid, depth_mm)
            labels = ("elevational / mm", "lateral / mm")
        else:
            middle = images.grid.width_mm / 2
            plane = along_sweep_plane(poses, images.grid, middle if lateral_mm is None else lateral_mm)
            labels = ("elevational / mm", "depth / mm")
        cut = reslice_frames(images, images.grid, poses, plane, reach_mm)
    decibel = cut / 255 * dynamic_range_db
    save_figure(figure_reslice({mode: (decibel, plane)}, dynamic_range_db, sweep.name, labels), out)
