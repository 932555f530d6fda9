"""Scenes for 3D Slicer."""

from __future__ import annotations

from typing import Annotated, Any

from speckle3d.cli.calibrations import files_of
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import (
    CalibrationFiles,
    ConfigFile,
    Modes,
    Out,
    PosedFile,
    SweepFile,
    Transform,
    note,
)
from speckle3d.cli.look.compounding import Imported, compounding_settings, open_sweep_at, statement
from speckle3d.core.progress import progress_bar


def scene(
    source: PosedFile,
    out: Out,
    *,
    mode: Modes = None,
    images: bool = False,
    deviation: bool = False,
    settings: Annotated[
        dict[str, Any],
        Fields(
            "speckle3d.imaging.voxels.settings:CompoundingSettings",
            ("voxel_mm", "splat", "rule", "fill_radius", "dynamic_range_db"),
        ),
    ],
    sweep_file: SweepFile = None,
    calibration: CalibrationFiles = None,
    transform: Transform = None,
    imported: Imported,
    config_file: ConfigFile = None,
) -> None:
    """Write a folder that opens in 3D Slicer: volumes, labels of voxels, outlines and poses of frames.

    Parameters
    ----------
    source
    out
        Folder to write; open its scene.mrml.
    mode
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

    require_scene_place(out, source, sweep_file, *files_of(imported, calibration))
    stated = statement(source, sweep_file, imported, transform, calibration, settings.get("dynamic_range_db"))
    request = SceneRequest(
        compounding_settings(config_file, settings), with_images=images, with_deviation=deviation
    )
    posed = open_sweep_at(mode or [None], source, stated)
    with progress_bar(f"writing {out.name}") as progress:
        reports = write_scene(out, posed, request, progress)
    for report in reports:
        note(report.line)
