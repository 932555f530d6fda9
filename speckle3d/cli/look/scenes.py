"""Scenes for 3D Slicer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from speckle3d.cli.calibrations import files_of
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import MaybePath, MaybeText, Out, Paths, note
from speckle3d.cli.look.compounding import Imported, compounding_settings, open_sweep_at, statement
from speckle3d.core.progress import progress_bar


def scene(
    input_file: Path,
    out: Out,
    *,
    mode: list[str] | None = None,
    images: bool = False,
    deviation: bool = False,
    settings: Annotated[
        dict[str, Any],
        Fields(
            "speckle3d.imaging.voxels.settings:CompoundingSettings",
            ("voxel_mm", "splat", "rule", "fill_radius", "dynamic_range_db"),
        ),
    ],
    sweep_file: MaybePath = None,
    calibration: Paths = None,
    transform: MaybeText = None,
    imported: Imported,
    config_file: MaybePath = None,
) -> None:
    """Write a folder that opens in 3D Slicer: volumes, labels of voxels, outlines and poses of frames.

    Parameters
    ----------
    input_file
    out
        Folder to write; open its scene.mrml.
    mode
        As for `volume`; may be repeated.
    images
        Also the images, which play as they move through the volume.
    voxel_mm, calibration

    Other Parameters
    ----------------
    deviation
        Also each voxel's standard deviation of position, mm.
    splat, rule, fill_radius, dynamic_range_db, sweep_file, config_file, transform

    Examples
    --------
    $ speckle3d scene out/reconstruction.h5 -o scene --images
    """
    from speckle3d.study.scenes.scene import SceneRequest, require_scene_place, write_scene

    require_scene_place(out, input_file, sweep_file, *files_of(imported, calibration))
    stated = statement(
        input_file, sweep_file, imported, transform, calibration, settings.get("dynamic_range_db")
    )
    request = SceneRequest(
        compounding_settings(config_file, settings), with_images=images, with_deviation=deviation
    )
    posed = open_sweep_at(mode or [None], input_file, stated)
    with progress_bar(f"writing {out.name}") as progress:
        reports = write_scene(out, posed, request, progress)
    for report in reports:
        note(report.line)
