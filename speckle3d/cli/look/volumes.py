"""Voxels of a reconstructed or tracked sweep."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer

from speckle3d.cli.common import (
    CalibrationFiles,
    ConfigFile,
    Json,
    Mode,
    PosedFile,
    SweepFile,
    Transform,
    app,
    emit_json,
    note,
)
from speckle3d.cli.importing import (
    Importing,
    Number,
    PlusConfig,
    ReferenceTransform,
    files_of,
)
from speckle3d.cli.look.compounding import (
    FillRadius,
    LevelRange,
    Rule,
    Splat,
    VoxelMm,
    clip_of,
    compounding_settings,
    open_sweep_at,
)
from speckle3d.cli.outputs import require_own_places
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import progress_bar

Three = tuple[float, float, float]


@app.command(cls=Importing)
def volume(
    source: PosedFile,
    out: Annotated[Path, typer.Option("-o", "--output", help="VOLUME.nrrd, .mha, .nii.gz or .nii to write.")],
    mode: Mode = None,
    voxel_mm: VoxelMm = None,
    splat: Splat = None,
    rule: Rule = None,
    fill_radius: FillRadius = None,
    fill_mm: Annotated[
        float | None, typer.Option(help="Instead, in mm along each axis, whatever the voxels' shape.")
    ] = None,
    voxel_type: Annotated[
        str | None, typer.Option(help="uint8, int16, uint16 or float32, in which empty voxels are NaN.")
    ] = None,
    levels: Annotated[
        str | None, typer.Option(help="log, linear, or stored (B-mode as it is, which is the default).")
    ] = None,
    dynamic_range_db: LevelRange = None,
    axes: Annotated[
        Literal["sweep", "world", "principal"],
        typer.Option(help="Of the voxels: sweep (mean of the images), world, principal (smallest box)."),
    ] = "sweep",
    spacing_mm: Annotated[Three | None, typer.Option(help="Voxels' sides along each axis.")] = None,
    origin_mm: Annotated[Three | None, typer.Option(help="Centre of the first voxel in the world.")] = None,
    shape: Annotated[
        tuple[int, int, int] | None, typer.Option(help="Number of voxels along each axis.")
    ] = None,
    size_mm: Annotated[Three | None, typer.Option(help="Instead: size along each axis, mm.")] = None,
    within_gb: Annotated[
        float | None,
        typer.Option(help="Instead of a spacing: the finest round one of a volume no larger than this."),
    ] = None,
    like: Annotated[Path | None, typer.Option(help="A volume whose grid to take.")] = None,
    region: Annotated[
        str | None,
        typer.Option(
            help="What counts of an image, in mm and degrees: 'rectangle x,y x,y', 'polygon x,y x,y x,y ...' "
            "or 'fan x,y angle,angle radius,radius'; several joined by ' and '."
        ),
    ] = None,
    state: Annotated[
        Path | None, typer.Option(help="Write which voxels are measured and filled, as labels.")
    ] = None,
    deviation: Annotated[
        Path | None,
        typer.Option(help="Write each voxel's standard deviation of position along the sweep, mm."),
    ] = None,
    backward_mm: Annotated[
        float | None,
        typer.Option(help="For sparse sweeps: voxels between the nearest images, at most so far away."),
    ] = None,
    max_memory_gb: Annotated[float | None, typer.Option(help="Memory that making it may take (8).")] = None,
    sweep_file: SweepFile = None,
    calibration: CalibrationFiles = None,
    plus_config: PlusConfig = None,
    transform: Transform = None,
    reference_transform: ReferenceTransform = None,
    column_pitch_mm: Number = None,
    row_spacing_mm: Number = None,
    frame_rate_hz: Number = None,
    config_file: ConfigFile = None,
    as_json: Json = False,
) -> None:
    """Compound the frames into voxels, at the poses of one mode or of the recording itself."""
    from speckle3d.imaging.region import Region
    from speckle3d.study.pose_errors import caution
    from speckle3d.study.scenes.voxels import GridRequest, VolumeRequest, write_voxels

    options = locals()
    inputs = (source, sweep_file, like, *files_of(plus_config, calibration))
    require_own_places({"--output": out, "--state": state, "--deviation": deviation}, "volume", *inputs)
    _require_alone(
        {"--voxel-mm": voxel_mm}, {"--spacing-mm": spacing_mm, "--within-gb": within_gb, "--like": like}
    )
    _require_alone(
        {"--splat": splat, "--rule": rule, "--fill-radius": fill_radius, "--fill-mm": fill_mm},
        {"--backward-mm": backward_mm or None},
    )
    settings = compounding_settings(config_file, options)
    (posed,) = open_sweep_at([mode], source, options)
    region = region or clip_of(source, options, posed)
    request = VolumeRequest(
        out,
        settings,
        GridRequest(axes, spacing_mm, origin_mm, shape, size_mm, within_gb, like),
        None if region is None else Region.from_text(region),
        state,
        deviation,
    )
    with progress_bar(f"compounding {out.name}") as progress:
        report = write_voxels(posed, request, progress)
    if as_json:
        emit_json(report.summary())
    made = posed.reconstruction
    if deviation is not None and made is not None and (words := caution(made, posed.mode)) is not None:
        note(words)
    note(report.line)


def _require_alone(options: Mapping[str, object], others: Mapping[str, object]) -> None:
    """Refuse options that would say nothing beside others."""
    given = [name for name, value in options.items() if value is not None]
    beside = [name for name, value in others.items() if value is not None]
    if given and beside:
        raise InvalidInputError(f"{given[0]}: expected no {beside[0]} beside it, which takes its place")
