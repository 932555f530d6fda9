"""Commands about files: what one holds, the configuration, conversion, simulation."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import speckle3d as s3
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import (
    MaybePath,
    MaybeText,
    OutArgument,
    Paths,
    Result,
    clip_of,
    emit,
    mount,
    note,
    rows_of,
)
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError


def info(path: Path) -> Result:
    """Tell what a file holds, after checking it.

    Parameters
    ----------
    path
        A file or folder that the package reads.
    as_json

    Examples
    --------
    $ speckle3d info sweep.h5
    """
    from speckle3d.cli.describe import describe

    return rows_of(describe(path))


def config() -> None:
    """Print every setting with what it is, its unit and its default, as TOML.

    Examples
    --------
    $ speckle3d config > settings.toml
    """
    emit(s3.Config().to_toml(comments=True))


def convert(
    source: Path,
    out: Annotated[OutArgument, "sweep sequence"],
    settings: Annotated[
        Any,
        Fields("speckle3d.io.import_settings:ImportSettings", without=("image_to_probe", "arrays")),
    ],
    calibration: Paths = None,
    compression: Annotated[
        Literal["gzip", "lzf", "none"] | None, typer.Option("--compression", "--compress")
    ] = None,
    mode: MaybeText = None,
    sweep_file: MaybePath = None,
) -> None:
    """Turn any recording into a sweep file, or into a sequence of PLUS; options give what it lacks.

    A reconstruction becomes a sequence of grey images with its poses as ImageToWorldTransform, which 3D
    Slicer (.seq.nrrd) and SlicerIGSIO (.seq.mha) play in their world: axes lead right, anterior, superior.

    A calibration goes in: the image's place on its sensor, and its pixel size.

    Parameters
    ----------
    source
        Any recording that holds a sweep: a file, or a folder.
    out
        Sweep file (.h5, .hdf5), or sequence of PLUS (.mha, .nrrd), to write; or -o OUT.
    calibration
    mode
        Which poses of a reconstruction (by default those that claim the smallest error of length).
    column_pitch_mm, row_spacing_mm, frame_rate_hz, plus_config

    Other Parameters
    ----------------
    compression
        gzip, some 0.65 of the size; lzf, faster and larger; or none: of a sweep file by default.

    Examples
    --------
    $ speckle3d convert scan.mha sweep.h5 --calibration tracker.h5
    """
    from speckle3d.calibrating.recordings import require_unsaid
    from speckle3d.calibration_files import fitted_pixels, resized
    from speckle3d.io.family.reconstructions import FORMAT
    from speckle3d.io.hdf5 import require_suffix
    from speckle3d.io.load import kind_of, open_recording
    from speckle3d.io.plus.write import SUFFIXES, write_sequence
    from speckle3d.study.posed import USUAL_RANGE_DB, open_posed
    from speckle3d.study.scenes.scene import slicer_sequence

    is_reconstruction = kind_of(source) == FORMAT
    suffix = require_suffix(out, SUFFIXES if is_reconstruction else (".h5", ".hdf5", *SUFFIXES))
    packs = compression != "none"
    if is_reconstruction:
        range_db = settings.dynamic_range_db or USUAL_RANGE_DB
        others = type(settings)(**settings.model_dump(exclude={"dynamic_range_db"}, exclude_unset=True))
        posed = open_posed(source, mode, sweep_file, others, calibration or ())
        note(*posed.notes())
        with s3.progress_bar(f"writing {out.name}") as progress:
            sequence, poses = slicer_sequence(posed, range_db)
            write_sequence(out, sequence, progress, packs, poses)
        return
    if mode or sweep_file:
        raise InvalidInputError(f"--mode, --sweep: are of a reconstruction, got {source.name}")
    require_unsaid(source, settings)
    pixels = fitted_pixels(calibration or ())
    sizes = {name: pixels[name] for name in pixels.keys() - settings.model_fields_set}
    recording = open_recording(source, settings.model_copy(update=sizes))
    sweep = mount(resized(recording.sweep, sizes), calibration or ())
    note(*recording.notes)
    config = recording.settings.plus_config
    if region := clip_of(config, sweep.grid, 0.0 if sweep.tracker is None else sweep.tracker.image_skew_rad):
        note(f"{out}: does not hold the clip of {config}: give `speckle3d volume` --region '{region}'")
    with s3.progress_bar(f"writing {out.name}") as progress:
        if suffix not in SUFFIXES:
            s3.write_sweep(out, sweep, progress, None if compression == "none" else compression)
            return
        left_out = write_sequence(out, sweep, progress, packs)
    for part in left_out:
        note(f"{out}: does not hold {part}")


def simulate(
    out: Annotated[OutArgument, "simulation"],
    settings: Annotated[Any, Fields("speckle3d.simulation.settings:SimulationSettings")],
) -> None:
    """Simulate a sweep with truth; `crossed` writes a second file beside the first, named ...-crossing.

    Parameters
    ----------
    out
        Sweep file to write; or -o OUT.
    preset, seed, length_mm, vectors, uncalibrated, signal

    Examples
    --------
    $ speckle3d simulate sweep.h5 --preset tissue --length-mm 8 --seed 4
    """
    with s3.progress_bar("computing the beam"):
        simulations = s3.simulate(settings)
    paths = [out, out.with_name(f"{out.stem}-crossing{out.suffix}")][: len(simulations)]
    require_own_place(paths[-1], "simulation")
    for path, simulation in zip(paths, simulations, strict=True):
        with s3.progress_bar(f"simulating {path.name}") as progress:
            s3.write_sweep(path, simulation.sweep, progress, simulation=simulation.description())
