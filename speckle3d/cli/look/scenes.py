"""Scenes for 3D Slicer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from speckle3d.cli.common import (
    CalibrationFiles,
    ConfigFile,
    Modes,
    PosedFile,
    SweepFile,
    Transform,
    app,
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
    compounding_settings,
    open_sweep_at,
)
from speckle3d.core.progress import progress_bar


@app.command(cls=Importing)
def scene(
    source: PosedFile,
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder to write; open its scene.mrml.")],
    mode: Modes = None,
    images: Annotated[
        bool, typer.Option("--images", help="Also the images, which play as they move through the volume.")
    ] = False,
    deviation: Annotated[
        bool, typer.Option("--deviation", help="Also each voxel's standard deviation of position, mm.")
    ] = False,
    voxel_mm: VoxelMm = None,
    splat: Splat = None,
    rule: Rule = None,
    fill_radius: FillRadius = None,
    dynamic_range_db: LevelRange = None,
    sweep_file: SweepFile = None,
    calibration: CalibrationFiles = None,
    plus_config: PlusConfig = None,
    transform: Transform = None,
    reference_transform: ReferenceTransform = None,
    column_pitch_mm: Number = None,
    row_spacing_mm: Number = None,
    frame_rate_hz: Number = None,
    config_file: ConfigFile = None,
) -> None:
    """Write a folder that opens in 3D Slicer: volumes, labels of voxels, outlines and poses of frames."""
    from speckle3d.study.scenes.scene import SceneRequest, require_scene_place, write_scene

    options = locals()
    require_scene_place(out, source, sweep_file, *files_of(plus_config, calibration))
    settings = compounding_settings(config_file, options)
    posed = open_sweep_at(mode or [None], source, options)
    request = SceneRequest(settings, with_images=images, with_deviation=deviation)
    with progress_bar(f"writing {out.name}") as progress:
        reports = write_scene(out, posed, request, progress)
    for report in reports:
        note(report.line)
