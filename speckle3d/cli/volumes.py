"""Voxels of a reconstructed or tracked sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from speckle3d.cli.common import DynamicRange, Mode, PosedFile, SweepFile, app, progress_bar
from speckle3d.cli.outputs import require_own_place


@app.command()
def volume(
    source: PosedFile,
    out: Annotated[Path, typer.Option("-o", "--output", help="VOLUME.nrrd, .mha or .nii.gz to write.")],
    mode: Mode = None,
    voxel_mm: Annotated[float, typer.Option(help="Side of a voxel.")] = 0.2,
    sweep_file: SweepFile = None,
    dynamic_range_db: DynamicRange = 60.0,
) -> None:
    """Compound the frames into voxels, at the poses of one mode."""
    from speckle3d.imaging.volume import compound
    from speckle3d.io.volumes import write_volume
    from speckle3d.study.posed import open_posed

    require_own_place(out, "volume", source, sweep_file)
    posed = open_posed(source, mode, sweep_file)
    with progress_bar(f"compounding {out.name}") as progress:
        images, grid = posed.images(dynamic_range_db, progress)
        voxels = compound(images, grid, posed.world_from_image, voxel_mm, voxel_type="uint8")
    write_volume(out, voxels)
