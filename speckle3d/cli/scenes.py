"""Scenes for 3D Slicer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from speckle3d.cli.common import DynamicRange, PosedFile, SweepFile, app, progress_bar


@app.command()
def scene(
    source: PosedFile,
    out: Annotated[Path, typer.Option("-o", "--output", help="Folder to write; open its scene.mrml.")],
    mode: Annotated[
        list[str] | None,
        typer.Option(
            help="Which poses to use: image (default), orientation, pose, crossed, inertial, fused of a "
            "reconstruction; tracker, truth of a recording. May be repeated."
        ),
    ] = None,
    voxel_mm: Annotated[float, typer.Option(help="Side of a voxel.")] = 0.2,
    sweep_file: SweepFile = None,
    dynamic_range_db: DynamicRange = 60.0,
) -> None:
    """Write a folder that opens in 3D Slicer: volumes, labels of voxels, outlines and poses of frames."""
    from speckle3d.study.posed import open_posed
    from speckle3d.study.scene import SceneSettings, require_scene_place, write_scene

    require_scene_place(out, source, sweep_file)
    modes: list[str | None] = list(mode) if mode else [None]
    posed = [open_posed(source, each, sweep_file) for each in modes]
    settings = SceneSettings(voxel_mm=voxel_mm, dynamic_range_db=dynamic_range_db)
    with progress_bar(f"writing {out.name}") as progress:
        write_scene(out, posed, settings, progress)
