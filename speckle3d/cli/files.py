"""Commands about files: what one holds, the configuration, conversion, simulation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.calibrations import mount
from speckle3d.cli.common import CalibrationFiles, Json, SweepFile, Transform, app, emit, emit_rows, note
from speckle3d.cli.importing import (
    Importing,
    Number,
    PlusConfig,
    ReferenceTransform,
    files_of,
    given_settings,
)
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    pass


@app.command()
def info(
    path: Annotated[Path, typer.Argument(help="A file or folder that the package reads.")],
    as_json: Json = False,
) -> None:
    """Tell what a file holds, after checking it."""
    from speckle3d.io.describe import describe

    emit_rows(describe(path), as_json)


@app.command()
def config() -> None:
    """Print every setting with what it is, its unit and its default, as TOML."""
    from speckle3d.config import Config

    emit(Config().to_toml(comments=True))


@app.command(cls=Importing)
def convert(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="Any recording that holds a sweep: a file, or a folder.")
    ],
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="Sweep file (.h5, .hdf5), or sequence of PLUS (.mha, .mhd, .nrrd), to write; or -o OUT.",
        ),
    ],
    sampling_rate_hz: Number = None,
    vector_pitch_mm: Number = None,
    element_pitch_mm: Number = None,
    speed_of_sound_m_s: Number = None,
    centre_frequency_hz: Number = None,
    bandwidth_hz: Annotated[tuple[float, float] | None, typer.Option()] = None,
    demodulation_frequency_hz: Number = None,
    first_sample_depth_mm: Number = None,
    column_pitch_mm: Number = None,
    row_spacing_mm: Number = None,
    dynamic_range_db: Number = None,
    frame_rate_hz: Number = None,
    probe: Annotated[str | None, typer.Option(metavar="MODEL")] = None,
    plus_config: PlusConfig = None,
    transform: Transform = None,
    reference_transform: ReferenceTransform = None,
    calibration: CalibrationFiles = None,
    compression: Annotated[
        str | None,
        typer.Option(
            "--compression",
            "--compress",
            help="gzip, some 0.65 of the size; lzf, faster and larger; or none: of a sweep file by default.",
        ),
    ] = None,
    mode: Annotated[
        str | None,
        typer.Option(help="IN a reconstruction: write its grey images with the poses of a mode (image)."),
    ] = None,
    sweep_file: SweepFile = None,
) -> None:
    """Turn any recording into a sweep file, or into a sequence of PLUS; options give what it lacks.

    A reconstruction becomes a sequence of grey images with its poses as ImageToWorldTransform, which 3D
    Slicer (.seq.nrrd) and SlicerIGSIO (.seq.mha) play in their world: axes lead right, anterior, superior.

    A calibration goes into the file: where the image is relative to its sensor, and the pixel size of B-mode
    unless options give it.
    """
    from speckle3d.io.calibrations import fitted_pixels, resized
    from speckle3d.io.load import open_recording
    from speckle3d.io.plus.write import SUFFIXES, write_sequence
    from speckle3d.io.sweep_writer import COMPRESSIONS, write_sweep
    from speckle3d.io.voxels.volume_writer import LABELS_ALONE

    options = locals()
    suffix = out.suffix.lower()
    if out.name.lower().endswith(LABELS_ALONE):
        raise InvalidInputError(f"{out}: {LABELS_ALONE} is of labels: take a name ending in .seq.nrrd")
    if suffix not in ("", ".h5", ".hdf5", *SUFFIXES):
        known = ", ".join((".h5", ".hdf5", *SUFFIXES))
        raise InvalidInputError(f"{out}: expected a name ending in {known}, got {suffix!r}")
    named = files_of(plus_config, calibration)
    require_own_place(out, "sequence" if suffix in SUFFIXES else "sweep", source, *named)
    if _is_reconstruction(source):
        _convert_posed(source, out, options)
        return
    for name, value in (("--mode", mode), ("--sweep", sweep_file)):
        if value is not None:
            raise InvalidInputError(f"{name} {value}: is of a reconstruction, got {source.name}")
    if compression not in (None, *COMPRESSIONS):
        raise InvalidInputError(f"--compression: expected {', '.join(COMPRESSIONS)}, got {compression!r}")
    given = given_settings(source, options)
    fitted = {k: v for k, v in fitted_pixels(calibration or ()).items() if k not in given.model_fields_set}
    settings = given.model_copy(update=fitted)
    recording = open_recording(source, settings)
    sweep = mount(resized(recording.sweep, fitted), calibration or ())
    for each in recording.notes:
        note(each)
    with progress_bar(f"writing {out.name}") as progress:
        if suffix not in SUFFIXES:
            write_sweep(out, sweep, progress, COMPRESSIONS[compression or "none"])
            return
        left_out = write_sequence(out, sweep, progress, compression != "none")
    for each in left_out:
        note(f"{out}: does not hold {each}")


def _is_reconstruction(path: Path) -> bool:
    from speckle3d.io.load import kind_of
    from speckle3d.io.reconstructions import FORMAT

    return path.is_file() and kind_of(path) == FORMAT


def _convert_posed(source: Path, out: Path, options: dict[str, Any]) -> None:
    """Write a reconstruction's images with its poses; other options than those of that have no effect."""
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.io.plus.write import SUFFIXES, write_sequence
    from speckle3d.study.posed import open_posed
    from speckle3d.study.scenes.sequences import slicer_sequence

    if out.suffix.lower() not in SUFFIXES:
        raise InvalidInputError(f"{out}: expected a name ending in {', '.join(SUFFIXES)} of a reconstruction")
    of_recordings = {*ImportSettings.model_fields, "transform", "plus_config", "calibration"}
    unused = [name for name in of_recordings - {"dynamic_range_db"} if options.get(name) is not None]
    if unused:
        raise InvalidInputError(f"--{unused[0].replace('_', '-')}: is of recordings, got a reconstruction")
    posed = open_posed(source, options["mode"], options["sweep_file"])
    range_db, packs = options["dynamic_range_db"] or 60.0, options["compression"] != "none"
    with progress_bar(f"writing {out.name}") as progress:
        sweep, poses = slicer_sequence(posed, range_db)
        write_sequence(out, sweep, progress, packs, poses)
