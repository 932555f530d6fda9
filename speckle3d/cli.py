"""The command line. Heavy modules are imported inside the commands, so that help and errors come at once."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

# Small factorisations lose far more to a team of threads than they gain; set before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError

app = typer.Typer(
    name="speckle3d",
    help="Freehand 2-D ultrasound sweeps to measured 3-D.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
calibrate = typer.Typer(help="Calibrate what a reconstruction needs.", no_args_is_help=True)
app.add_typer(calibrate, name="calibrate")

Json = Annotated[bool, typer.Option("--json", help="Print machine-readable results on stdout.")]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="TOML with settings to change; see `speckle3d config`.")
]

_STOPPED = 130
"""Exit code after Ctrl-C, as shells have it."""


def main() -> None:
    """Run the command line: a wrong input is one line on stderr and exit code 2."""
    try:
        code = app(standalone_mode=False)
    except Speckle3DError as error:
        _fail(str(error))
    except (KeyboardInterrupt, typer.Abort):
        _fail("stopped", _STOPPED)
    except typer.Exit as leave:
        sys.exit(leave.exit_code)
    except Exception as error:
        # Typer's own usage errors carry an exit code; anything else is a bug and shows its traceback.
        if not hasattr(error, "format_message"):
            raise
        # Called with no command at all, it has shown its help and has nothing to say.
        if not error.format_message().strip():
            sys.exit(2)
        _fail(error.format_message())
    # Typer turns Ctrl-C into this exit code without a word.
    if code == _STOPPED:
        _fail("stopped", _STOPPED)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str, code: int = 2) -> None:
    sys.stderr.write(f"speckle3d: {' '.join(message.split())}\n")
    sys.exit(code)


@contextmanager
def _progress(what: str) -> Iterator[Any]:
    """A bar on stderr; yields a function of frames done and frames in all."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    # In a log a bar is noise, and an error must stay one line.
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _note(text: str) -> None:
    sys.stderr.write(text + "\n")


def _emit(text: str) -> None:
    try:
        sys.stdout.write(text if text.endswith("\n") else text + "\n")
        sys.stdout.flush()
    except OSError as error:
        raise FileError(f"standard output: cannot be written: {error.strerror}") from error


@app.command()
def info(
    path: Annotated[Path, typer.Argument(help="A file the package reads.")], as_json: Json = False
) -> None:
    """Tell what a file holds, after checking it."""
    from speckle3d.io.load import describe

    rows = describe(path)
    if as_json:
        _emit(json.dumps([{"description": d, "value": v, "unit": u} for d, v, u in rows], indent=2))
        return
    width = max(len(d) for d, _, _ in rows)
    for description, value, unit in rows:
        _emit(f"{description.ljust(width)}  {value} {unit}".rstrip())


@app.command()
def config() -> None:
    """Print the default configuration as TOML."""
    from speckle3d.config import Config

    _emit(Config().to_toml())


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(help="Sweep file to write.")],
    preset: Annotated[
        str, typer.Option(help="phantom, tissue, reversal, rotation, crossed or stepped.")
    ] = "phantom",
    seed: Annotated[int, typer.Option(help="Same seed and settings, same sweep.")] = 0,
    vectors: Annotated[int | None, typer.Option(help="Vectors in a frame (127).")] = None,
    samples: Annotated[int | None, typer.Option(help="Samples in a vector (3818).")] = None,
    length_mm: Annotated[float | None, typer.Option(help="Length of the sweep (20).")] = None,
    frames: Annotated[int | None, typer.Option(help="Frames; by default eight per mm.")] = None,
    steps: Annotated[int | None, typer.Option(help="stepped: frames in a block.")] = None,
    step_mm: Annotated[float | None, typer.Option(help="stepped: distance between them.")] = None,
    blocks: Annotated[int | None, typer.Option(help="stepped: independent blocks.")] = None,
    turn_deg: Annotated[float | None, typer.Option(help="rotation: the deliberate turn.")] = None,
    turn_axis: Annotated[str | None, typer.Option(help="rotation: tilt or yaw.")] = None,
    drift_mm: Annotated[float | None, typer.Option(help="Slow lateral and axial wander (0.5).")] = None,
    snr_db: Annotated[float | None, typer.Option(help="Speckle over electronic noise (40).")] = None,
) -> None:
    """Simulate a sweep with truth; `crossed` writes a second file beside the first, named ...-crossing."""
    from pydantic import ValidationError

    from speckle3d.io.sweep_writer import write_sweep
    from speckle3d.simulation.presets import SimulationSettings
    from speckle3d.simulation.presets import simulate as prepare

    given = {k: v for k, v in locals().items() if k in SimulationSettings.model_fields and v is not None}
    try:
        settings = SimulationSettings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise InvalidInputError(
            f"--{name.replace('_', '-')}: {first['msg']}, got {first['input']!r}"
        ) from None
    for number, simulated in enumerate(prepare(settings)):
        path = out if number == 0 else out.with_name(f"{out.stem}-crossing{out.suffix}")
        with _progress(f"simulating {path.name}") as progress:
            write_sweep(path, simulated.sweep, progress, simulation=settings.model_dump(mode="json"))


@calibrate.command("curves")
def calibrate_curves(
    phantoms: Annotated[list[Path], typer.Argument(help="Phantom sweeps whose positions are known.")],
    out: Annotated[Path, typer.Option("-o", "--output", help="Curves file to write.")],
    config_file: ConfigFile = None,
    as_json: Json = False,
) -> None:
    """Measure decorrelation curves on phantom sweeps with known positions (/truth, or else /tracker)."""
    from speckle3d.config import Config, load_config
    from speckle3d.io.curves import write_curves
    from speckle3d.io.load import load_sweep
    from speckle3d.pipeline import calibrate_curves as measure

    settings = load_config(config_file) if config_file else Config()
    with _progress("correlating phantom frames") as progress:
        curves = measure([load_sweep(path) for path in phantoms], settings, progress)
    write_curves(out, curves)
    half = [_half_distance(curves.distance_mm, row) for row in curves.correlation]
    if as_json:
        table = {"depth_mm": curves.depth_mm.tolist(), "half_mm": half, "cells": curves.cells.tolist()}
        if curves.tilt is not None:
            table |= {name: values.tolist() for name, values in vars(curves.tilt).items()}
        _emit(json.dumps(table | {"pairs": curves.pairs_used}, indent=2))
        return
    _emit(f"{curves.pairs_used} frame pairs; correlation falls to one half at")
    for depth, distance, cells in zip(curves.depth_mm, half, curves.cells, strict=True):
        _emit(f"  {depth:5.1f} mm depth: {distance:.2f} mm  ({cells:.0f} independent cells in a patch)")
    if curves.tilt is None:
        _note("the phantom sweeps hardly turned: tilt will be taken to be about the image's centre")
    else:
        pivots = [
            f"{depth - pivot:.0f}" for depth, pivot in zip(curves.depth_mm, curves.tilt.pivot_mm, strict=True)
        ]
        _note(
            f"tilted frames decorrelate as if they turned about a point {pivots[0]} to {pivots[-1]} mm deep"
        )


def _half_distance(distance_mm: Any, correlation: Any) -> float:
    first = int((correlation < 0.5).argmax())
    return float(distance_mm[first]) if first else float("nan")


@app.command()
def reconstruct(
    sweep_file: Annotated[Path, typer.Argument(metavar="SWEEP", help="Sweep to reconstruct.")],
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")],
    curves_file: Annotated[
        Path | None, typer.Option("--curves", help="Decorrelation curves; by default curves.h5 beside SWEEP.")
    ] = None,
    drift: Annotated[
        list[str] | None, typer.Option(help="Correction mode: orientation or pose; may be repeated.")
    ] = None,
    reference: Annotated[str | None, typer.Option(help="tracker or truth: what to compare with.")] = None,
    consistent_subset: Annotated[
        bool | None,
        typer.Option(help="In mode orientation, drop distances that the sensed orientation contradicts."),
    ] = None,
    drift_curves: Annotated[
        str | None, typer.Option(help="Correction cubic in time (published) or in distance (for reversals).")
    ] = None,
    config_file: ConfigFile = None,
    as_json: Json = False,
) -> None:
    """Reconstruct a sweep: trajectory, drift-corrected trajectories, table, figures."""
    from speckle3d.config import Config, load_config
    from speckle3d.io.curves import read_curves
    from speckle3d.io.load import load_sweep
    from speckle3d.study.job import run_job

    settings = load_config(config_file) if config_file else Config()
    settings = settings.with_choices(consistent_subset=consistent_subset, drift_curves=drift_curves)
    modes = list(dict.fromkeys(drift or ()))
    sweep = load_sweep(sweep_file)
    curves = read_curves(_find_curves(curves_file, sweep_file))
    with _progress(f"reconstructing {sweep_file.name}") as progress:
        result = run_job(sweep, sweep_file, curves, out, modes, reference, settings, progress)
    if as_json:
        _emit((result.directory / "summary.json").read_text(encoding="utf-8"))
        return
    _emit(result.table)
    details = result.summary.details
    for line in details["flagged_frames"]:
        _note(f"{line}: poses there are guesses")
    if 0 < result.summary.coverage < 1:
        _note(f"compared over the {100 * result.summary.coverage:.0f} % of frames that have a reference")
    rejected = details["rejected_patch_share"]
    if rejected == rejected:
        _note(f"{100 * rejected:.0f} % of patches contradict the sensed orientation and were left out")
    if details["direction_from"] == "truth":
        _note("the sign of the elevational motion was taken from the simulation's truth")
    if details["direction_from"] == "assumed":
        _note(
            "nothing tells the sign of the elevational motion: taken as positive (setting sensors.direction)"
        )
    _note(f"{len(sweep)} frames in {result.seconds:.1f} s; results in {result.directory}")


def _find_curves(given: Path | None, sweep_file: Path) -> Path:
    if given is not None:
        return given
    beside = sweep_file.parent / "curves.h5"
    if not beside.is_file():
        raise InvalidInputError(
            f"expected decorrelation curves: --curves CURVES.h5 or {beside}, got neither "
            "(speckle3d calibrate curves makes them from a phantom sweep)"
        )
    _note(f"curves: {beside}")
    return beside


@app.command()
def volume(
    reconstruction_file: Annotated[Path, typer.Argument(metavar="RECONSTRUCTION")],
    out: Annotated[Path, typer.Option("-o", "--output", help="VOLUME.nrrd, .mha or .nii.gz to write.")],
    mode: Annotated[str, typer.Option(help="image, orientation, pose: which poses to use.")] = "image",
    voxel_mm: Annotated[float, typer.Option(help="Side of a voxel.")] = 0.2,
    sweep_file: Annotated[
        Path | None, typer.Option("--sweep", help="The sweep, if it moved since the reconstruction.")
    ] = None,
    dynamic_range_db: Annotated[float, typer.Option(help="Range of the log-compressed grey levels.")] = 60.0,
) -> None:
    """Compound the frames into voxels, at the poses of one mode."""
    from speckle3d.imaging.volume import compound
    from speckle3d.io.volumes import write_volume
    from speckle3d.study.images import grey_images, open_reconstruction

    reconstruction, sweep = open_reconstruction(reconstruction_file, sweep_file)
    with _progress(f"compounding {out.name}") as progress:
        images = grey_images(sweep, dynamic_range_db, progress, reconstruction)
        voxels = compound(images, images.grid, _poses(reconstruction, mode), voxel_mm, voxel_type="uint8")
    write_volume(out, voxels)


@app.command()
def reslice(
    reconstruction_file: Annotated[Path, typer.Argument(metavar="RECONSTRUCTION")],
    out: Annotated[Path, typer.Option("-o", "--output", help="PNG to write.")],
    mode: Annotated[str, typer.Option(help="image, orientation, pose: which poses to use.")] = "image",
    lateral_mm: Annotated[
        float | None, typer.Option(help="Cut along the sweep at this lateral position (middle).")
    ] = None,
    depth_mm: Annotated[float | None, typer.Option(help="Cut parallel to the skin at this depth.")] = None,
    reach_mm: Annotated[float, typer.Option(help="Frames farther from a pixel do not count.")] = 0.5,
    sweep_file: Annotated[
        Path | None, typer.Option("--sweep", help="The sweep, if it moved since the reconstruction.")
    ] = None,
    dynamic_range_db: Annotated[float, typer.Option(help="Range of the log-compressed grey levels.")] = 60.0,
) -> None:
    """Cut a plane straight from the frames, at the poses of one mode."""
    from speckle3d.imaging.reslice import along_sweep_plane, reslice_frames, surface_plane
    from speckle3d.study.figures import figure_reslice, save_figure
    from speckle3d.study.images import grey_images, open_reconstruction

    if lateral_mm is not None and depth_mm is not None:
        raise InvalidInputError("expected --lateral-mm or --depth-mm, got both")
    reconstruction, sweep = open_reconstruction(reconstruction_file, sweep_file)
    poses = _poses(reconstruction, mode)
    with _progress(f"reslicing {out.name}") as progress:
        images = grey_images(sweep, dynamic_range_db, progress, reconstruction)
        if depth_mm is not None:
            plane = surface_plane(poses, images.grid, depth_mm)
            labels = ("elevational / mm", "lateral / mm")
        else:
            middle = images.grid.width_mm / 2
            plane = along_sweep_plane(poses, images.grid, middle if lateral_mm is None else lateral_mm)
            labels = ("elevational / mm", "depth / mm")
        cut = reslice_frames(images, images.grid, poses, plane, reach_mm)
    extent = (0.0, plane.width_mm, plane.height_mm, 0.0)
    decibel = cut / 255 * dynamic_range_db
    figure = figure_reslice({mode: decibel}, {mode: extent}, dynamic_range_db, sweep.name, labels)
    save_figure(figure, out)


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="MetaImage, NRRD sequence or sweep file.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Sweep file to write.")],
    sampling_rate_hz: Annotated[float | None, typer.Option(help="RF sampling rate.")] = None,
    vector_pitch_mm: Annotated[float | None, typer.Option(help="Distance between vectors.")] = None,
    centre_frequency_hz: Annotated[float | None, typer.Option(help="RF centre frequency.")] = None,
    bandwidth_hz: Annotated[tuple[float, float] | None, typer.Option(help="RF band, low and high.")] = None,
    column_pitch_mm: Annotated[float | None, typer.Option(help="B-mode: distance between columns.")] = None,
    row_spacing_mm: Annotated[float | None, typer.Option(help="B-mode: distance between rows.")] = None,
    dynamic_range_db: Annotated[float | None, typer.Option(help="B-mode: dynamic range.")] = None,
    frame_rate_hz: Annotated[float | None, typer.Option(help="For sequences without time stamps.")] = None,
) -> None:
    """Turn an image sequence into a sweep file; options give what its header lacks."""
    from speckle3d.io.load import load_sweep
    from speckle3d.io.metaimage import ImportSettings
    from speckle3d.io.sweep_writer import write_sweep

    names = ImportSettings.__dataclass_fields__
    given = {k: v for k, v in locals().items() if k in names and v is not None}
    sweep = load_sweep(source, ImportSettings(**given))
    with _progress(f"writing {out.name}") as progress:
        write_sweep(out, sweep, progress)


def _poses(reconstruction: Any, mode: str) -> Any:
    if mode not in reconstruction.poses:
        held = ", ".join(reconstruction.poses)
        raise InvalidInputError(f"--mode: expected one of {held}, got {mode!r}")
    return reconstruction.poses[mode]


if __name__ == "__main__":
    main()
