"""A sweep at poses: its voxels, and scenes for 3D Slicer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from speckle3d.cli.calibrations import clip_of
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import (
    MaybePath,
    MaybeText,
    Out,
    Result,
    WritablePath,
    load_settings,
    note,
    notes,
)
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.core.grid import Region
    from speckle3d.imaging.voxels.settings import CompoundingSettings
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.study.posed import PosedSweep

_IMPORTED = (
    "plus_config",
    "reference_transform",
    "tracker_transform",
    "column_pitch_mm",
    "row_spacing_mm",
    "frame_rate_hz",
)
ImportOptions = Annotated[Any, Fields("speckle3d.io.import_settings:ImportSettings", _IMPORTED)]
"""Options of what a recording does not say; the range of its grey levels is that of the levels made."""
_SETTINGS = "speckle3d.imaging.voxels.settings:CompoundingSettings"
_SCENE = ("voxel_mm", "splat", "rule", "fill_radius", "dynamic_range_db")


@dataclass(frozen=True)
class SweepChoice:
    """Options of a sweep at poses: which file, with which calibrations, and what part of its images."""

    region: str | None = None
    sweep_file: Path | None = None
    calibration: list[Path] | None = None


SweepOptions = Annotated[Any, Fields("speckle3d.cli.look.volumes:SweepChoice")]


def compounding_settings(config_file: Path | None, options: CompoundingSettings) -> CompoundingSettings:
    """Group `volume` of a configuration, with the options that were given in its place."""
    from speckle3d.io.toml import validated

    base, values = load_settings(config_file).volume, options.model_dump(exclude_unset=True)
    return validated(base.model_dump() | values, "volume", type(base))


def open_sweep_at(
    modes: Sequence[str | None],
    source: Path,
    settings: ImportSettings,
    choice: SweepChoice,
    range_db: float | None = None,
) -> tuple[list[PosedSweep], Region | None]:
    """Open a sweep at the poses of each mode (None: the best), and note on stderr what it says of itself.

    The second result is the part of the images that counts: as asked for, else that to which a device set of
    PLUS clips volumes.
    """
    from speckle3d.calibrating.recordings import require_unsaid
    from speckle3d.core.grid import Region
    from speckle3d.io.import_settings import settings_for
    from speckle3d.study.posed import open_posed

    require_unsaid(source, settings)
    options = choice.sweep_file, settings, choice.calibration or (), range_db
    sweeps = [open_posed(source, mode, *options) for mode in modes]
    first = sweeps[0]
    notes(first.notes())
    clip = clip_of(settings_for(source, settings).plus_config, first.sweep.grid, first.skew_rad)
    region = choice.region or clip
    return sweeps, None if region is None else Region(region)


def volume(
    input_file: Path,
    out: Annotated[Out, "volume"],
    *,
    mode: MaybeText = None,
    settings: Annotated[Any, Fields(_SETTINGS)],
    grid: Annotated[Any, Fields("speckle3d.study.scenes.voxels:GridRequest")],
    choice: SweepOptions,
    state: Annotated[WritablePath, "volume labels"] = None,
    deviation: Annotated[WritablePath, "volume"] = None,
    recording: ImportOptions,
    config_file: MaybePath = None,
) -> Result:
    """Compound the frames into voxels, at the poses of one mode or of the recording itself.

    Parameters
    ----------
    input_file
    out
        VOLUME.nrrd, .mha, .nii.gz or .nii to write.
    mode, voxel_mm
    rule
        Of a voxel's samples: mean, maximum, latest, weighted by how well each frame's place is known; plus:
        in whole grey levels as PLUS and 3D Slicer keep it (mean).
    fill_radius
        Voxels across which holes are filled (3); 0: none.
    dynamic_range_db, calibration, as_json

    Other Parameters
    ----------------
    splat, fill_mm, voxel_type, levels
    backward_mm
        For sparse sweeps, voxels between the nearest images, at most so far away. Not with --splat or
        --rule or --fill-radius or --fill-mm.
    axes
        Of the voxels: sweep (mean of the images), world, principal (smallest box).
    spacing_mm
        Voxels' sides along each axis. Not with --voxel-mm.
    origin_mm
        Centre of the first voxel in the world.
    shape
        Number of voxels along each axis.
    size_mm
        Size along each axis, mm. Not with --shape.
    within_gb
        The finest round one of a volume no larger than this. Not with --voxel-mm or --spacing-mm or --shape.
    like
        A volume whose grid to take. Not with --voxel-mm or --axes or --spacing-mm or --origin-mm or --shape
        or --size-mm or --within-gb.
    region
    state
        Write which voxels are measured and filled, as labels.
    deviation
        Write each voxel's standard deviation of position along the sweep, mm.
    max_memory_gb, sweep_file, config_file, tracker_transform

    Examples
    --------
    $ speckle3d volume out/reconstruction.h5 -o volume.nrrd
    """
    from speckle3d.study.pose_errors import caution
    from speckle3d.study.scenes.voxels import VolumeRequest, write_voxels

    compounding = compounding_settings(config_file, settings)
    range_db = settings.model_dump(exclude_unset=True).get("dynamic_range_db")
    (posed,), part = open_sweep_at([mode], input_file, recording, choice, range_db)
    request = VolumeRequest(compounding, grid, part)
    with progress_bar(f"compounding {out.name}"):
        report = write_voxels(posed, request, out, state, deviation)
    if deviation is not None and posed.reconstruction is not None:
        notes([caution(posed.reconstruction, posed.mode)])
    note(report.line)
    return report.summary(), ""


def scene(
    input_file: Path,
    out: Out,
    *,
    mode: list[str] | None = None,
    images: bool = False,
    deviation: bool = False,
    settings: Annotated[Any, Fields(_SETTINGS, _SCENE)],
    choice: SweepOptions,
    recording: ImportOptions,
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
    splat, rule, fill_radius, region, dynamic_range_db, sweep_file, config_file, tracker_transform

    Examples
    --------
    $ speckle3d scene out/reconstruction.h5 -o scene --images
    """
    from speckle3d.study.scenes.scene import require_scene_place, write_scene
    from speckle3d.study.scenes.voxels import VolumeRequest

    require_scene_place(out, input_file, choice.sweep_file, *(choice.calibration or ()))
    compounding = compounding_settings(config_file, settings)
    range_db = settings.model_dump(exclude_unset=True).get("dynamic_range_db")
    modes = list(dict.fromkeys(mode)) if mode else [None]
    sweeps, part = open_sweep_at(modes, input_file, recording, choice, range_db)
    request = VolumeRequest(compounding, region=part)
    with progress_bar(f"writing {out.name}") as progress:
        reports = write_scene(out, sweeps, request, images, deviation, progress)
    for report in reports:
        note(report.line)
