"""A sweep at poses: its voxels, and scenes for 3D Slicer."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
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
    Written,
    load_settings,
    note,
    notes,
)
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.core.region import Region
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
Imported = Annotated[Any, Fields("speckle3d.io.import_settings:ImportSettings", _IMPORTED)]
"""Options of what a recording does not say; the range of its grey levels is that of the levels made."""
_SETTINGS = "speckle3d.imaging.voxels.settings:CompoundingSettings"
_SCENE = ("voxel_mm", "splat", "rule", "fill_radius", "dynamic_range_db")


@dataclass(frozen=True)
class Stated:
    """What options say of a sweep at poses, and of what counts of it."""

    region: str | None = None
    sweep_file: Path | None = None
    calibration: list[Path] | None = None


Statement = Annotated[Any, Fields("speckle3d.cli.look.volumes:Stated")]


def compounding_settings(config_file: Path | None, options: CompoundingSettings) -> CompoundingSettings:
    """Group `volume` of a configuration, with the options that were given in its place."""
    from speckle3d.io.toml import validated

    base, stated = load_settings(config_file).volume, options.model_dump(exclude_unset=True)
    return validated(base.model_dump() | stated, "volume", type(base))


def open_sweep_at(
    modes: Sequence[str | None],
    source: Path,
    imported: ImportSettings,
    stated: Stated,
    range_db: float | None,
) -> tuple[list[PosedSweep], Region | None]:
    """Open a sweep at the poses of each mode (None: the best), and say on stderr which frames have none.

    Of a recording it is told what was assumed of its images; nothing where a calibration gives its pixels.
    The second result is the part of the images that counts: as asked for, else that to which a device set of
    PLUS clips volumes.
    """
    from speckle3d.calibrating.recordings import require_unsaid
    from speckle3d.core.region import Region
    from speckle3d.io.import_settings import MissingSettingsError, settings_for
    from speckle3d.io.load import open_recording
    from speckle3d.study.posed import open_posed

    require_unsaid(source, imported)
    more = stated.sweep_file, imported, stated.calibration or (), range_db
    opened = [open_posed(source, mode, *more) for mode in modes]
    if opened[0].reconstruction is None:
        # Grey levels as stored need no dynamic range.
        ranged = imported.model_copy(update={"dynamic_range_db": 60.0})
        with suppress(MissingSettingsError):
            notes(
                line for line in open_recording(source, ranged).notes if not line.startswith("dynamic range")
            )
    notes(opened[0].notes())
    region = stated.region or clip_of(
        settings_for(source, imported).plus_config, opened[0].sweep.grid, opened[0].skew_rad
    )
    return opened, None if region is None else Region(region)


def volume(
    input_file: Path,
    out: Annotated[Out, "volume"],
    *,
    mode: MaybeText = None,
    settings: Annotated[Any, Fields(_SETTINGS)],
    grid: Annotated[Any, Fields("speckle3d.study.scenes.voxels:GridRequest")],
    stated: Statement,
    state: Annotated[Written, "volume"] = None,
    deviation: Annotated[Written, "volume"] = None,
    imported: Imported,
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

    checked = compounding_settings(config_file, settings)
    range_db = settings.model_dump(exclude_unset=True).get("dynamic_range_db")
    (posed,), part = open_sweep_at([mode], input_file, imported, stated, range_db)
    request = VolumeRequest(checked, grid, part)
    with progress_bar(f"compounding {out.name}"):
        report = write_voxels(posed, request, out, state, deviation)
    made = posed.reconstruction
    if deviation is not None and made is not None and (words := caution(made, posed.mode)) is not None:
        note(words)
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
    stated: Statement,
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
    splat, rule, fill_radius, region, dynamic_range_db, sweep_file, config_file, tracker_transform

    Examples
    --------
    $ speckle3d scene out/reconstruction.h5 -o scene --images
    """
    from speckle3d.study.scenes.scene import require_scene_place, write_scene
    from speckle3d.study.scenes.voxels import VolumeRequest

    require_scene_place(out, input_file, stated.sweep_file, *(stated.calibration or ()))
    checked = compounding_settings(config_file, settings)
    range_db = settings.model_dump(exclude_unset=True).get("dynamic_range_db")
    posed, part = open_sweep_at(mode or [None], input_file, imported, stated, range_db)
    request = VolumeRequest(checked, region=part)
    with progress_bar(f"writing {out.name}") as progress:
        reports = write_scene(out, posed, request, images, deviation, progress)
    for report in reports:
        note(report.line)
