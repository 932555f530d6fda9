"""Cuts through a reconstructed or tracked sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from speckle3d.cli.common import DynamicRange, Mode, PosedFile, SweepFile, app, progress_bar
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError


@app.command()
def reslice(
    source: PosedFile,
    out: Annotated[Path, typer.Option("-o", "--output", help="PNG to write.")],
    mode: Mode = None,
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
    from speckle3d.study.figures import figure_reslice, save_figure
    from speckle3d.study.posed import open_posed

    if lateral_mm is not None and depth_mm is not None:
        raise InvalidInputError("expected --lateral-mm or --depth-mm, got both")
    require_own_place(out, "picture", source, sweep_file)
    posed = open_posed(source, mode, sweep_file)
    poses = posed.world_from_image
    with progress_bar(f"reslicing {out.name}") as progress:
        images, grid = posed.images(dynamic_range_db, progress)
        if depth_mm is not None:
            plane = surface_plane(poses, grid, depth_mm)
            labels = ("elevational / mm", "lateral / mm")
        else:
            middle = grid.width_mm / 2
            plane = along_sweep_plane(poses, grid, middle if lateral_mm is None else lateral_mm)
            labels = ("elevational / mm", "depth / mm")
        cut = reslice_frames(images, grid, poses, plane, reach_mm)
    decibel = cut / 255 * dynamic_range_db
    title = posed.sweep.name
    save_figure(figure_reslice({posed.mode: (decibel, plane)}, dynamic_range_db, title, labels), out)
