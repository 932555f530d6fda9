"""A sweep at poses: its voxels, and scenes for 3D Slicer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from speckle3d.cli.calibrations import files_of, given_settings
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import (
    Json,
    MaybePath,
    MaybeText,
    Out,
    Paths,
    Written,
    emit_json,
    from_options,
    load_settings,
    note,
    notes,
)
from speckle3d.cli.outputs import require_own_place
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.core.region import Region
    from speckle3d.imaging.voxels.settings import CompoundingSettings
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.study.posed import PosedSweep

    Statement = tuple[Path | None, ImportSettings, Sequence[Path], float | None]

_IMPORTED = ("plus_config", "reference_transform", "column_pitch_mm", "row_spacing_mm", "frame_rate_hz")
Imported = Annotated[dict[str, Any], Fields("speckle3d.io.import_settings:ImportSettings", _IMPORTED)]
"""Options of what a recording does not say; the range of its grey levels is that of the levels made."""
_SETTINGS = "speckle3d.imaging.voxels.settings:CompoundingSettings"
_SCENE = ("voxel_mm", "splat", "rule", "fill_radius", "dynamic_range_db")


def compounding_settings(config_file: Path | None, options: Mapping[str, Any]) -> CompoundingSettings:
    """Group `volume` of a configuration, with the options that were given in its place."""
    from speckle3d.imaging.voxels.settings import CompoundingSettings

    base = load_settings(config_file).volume.model_dump()
    if options.get("levels") == "linear" and base["voxel_type"] == "uint8":
        base["voxel_type"] = "float32"  # amplitudes may be less than one, or thousands
    return from_options(CompoundingSettings, base | dict(options))


def open_sweep_at(modes: Sequence[str | None], source: Path, stated: Statement) -> list[PosedSweep]:
    """Open a sweep at the poses of each mode (None: the best), and say on stderr which frames have none.

    Of a recording it is told what was assumed of its images; nothing where a calibration gives its pixels.
    """
    from speckle3d.io.import_settings import MissingSettingsError
    from speckle3d.io.load import open_recording
    from speckle3d.study.posed import open_posed

    opened = [open_posed(source, mode, *stated) for mode in modes]
    if opened[0].reconstruction is None:
        # Grey levels as stored need no dynamic range.
        ranged = stated[1].model_copy(update={"dynamic_range_db": 60.0})
        with suppress(MissingSettingsError):
            notes(
                line for line in open_recording(source, ranged).notes if not line.startswith("dynamic range")
            )
    notes(opened[0].notes())
    return opened


def region_of(text: str | None, source: Path, stated: Statement, posed: PosedSweep) -> Region | None:
    """Part of the images that counts: as asked for, else that to which a device set of PLUS clips volumes."""
    from speckle3d.core.region import Region
    from speckle3d.io.import_settings import settings_for
    from speckle3d.io.plus.device_set import read_device_set

    config = settings_for(source, stated[1]).plus_config
    clip = None if text or config is None else read_device_set(config).clip
    if clip is not None:
        text = clip.region_text(replace(posed.sweep.grid, skew_rad=posed.skew_rad))
    return None if text is None else Region(text)


def volume(
    input_file: Path,
    out: Out,
    *,
    mode: MaybeText = None,
    settings: Annotated[dict[str, Any], Fields(_SETTINGS)],
    grid: Annotated[dict[str, Any], Fields("speckle3d.study.scenes.voxels:GridRequest")],
    region: MaybeText = None,
    state: Written = None,
    deviation: Written = None,
    sweep_file: MaybePath = None,
    calibration: Paths = None,
    transform: MaybeText = None,
    imported: Imported,
    config_file: MaybePath = None,
    as_json: Json = False,
) -> None:
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
    max_memory_gb, sweep_file, config_file, transform

    Examples
    --------
    $ speckle3d volume out/reconstruction.h5 -o volume.nrrd
    """
    from speckle3d.study.pose_errors import caution
    from speckle3d.study.scenes.voxels import GridRequest, VolumeRequest, write_voxels

    inputs = (input_file, sweep_file, grid.get("like"), *files_of(imported, calibration))
    outputs = [path.resolve() for path in (out, state, deviation) if path is not None]
    for path in outputs:
        require_own_place(path, "volume", *inputs)
        if outputs.count(path) > 1:
            raise InvalidInputError(f"{path}: expected a file for each of --output, --state and --deviation")
    checked = compounding_settings(config_file, settings)
    imports = given_settings(input_file, imported, transform)
    stated = sweep_file, imports, calibration or (), settings.get("dynamic_range_db")
    (posed,) = open_sweep_at([mode], input_file, stated)
    part = region_of(region, input_file, stated, posed)
    request = VolumeRequest(checked, GridRequest(**grid), part)
    with progress_bar(f"compounding {out.name}"):
        report = write_voxels(posed, request, out, state, deviation)
    if as_json:
        emit_json(report.summary())
    made = posed.reconstruction
    if deviation is not None and made is not None and (words := caution(made, posed.mode)) is not None:
        note(words)
    note(report.line)


def scene(
    input_file: Path,
    out: Out,
    *,
    mode: list[str] | None = None,
    images: bool = False,
    deviation: bool = False,
    settings: Annotated[dict[str, Any], Fields(_SETTINGS, _SCENE)],
    region: MaybeText = None,
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
    splat, rule, fill_radius, region, dynamic_range_db, sweep_file, config_file, transform

    Examples
    --------
    $ speckle3d scene out/reconstruction.h5 -o scene --images
    """
    from speckle3d.study.scenes.scene import require_scene_place, write_scene
    from speckle3d.study.scenes.voxels import VolumeRequest

    require_scene_place(out, input_file, sweep_file, *files_of(imported, calibration))
    imports = given_settings(input_file, imported, transform)
    stated = sweep_file, imports, calibration or (), settings.get("dynamic_range_db")
    checked = compounding_settings(config_file, settings)
    posed = open_sweep_at(mode or [None], input_file, stated)
    part = region_of(region, input_file, stated, posed[0])
    request = VolumeRequest(checked, region=part)
    with progress_bar(f"writing {out.name}") as progress:
        reports = write_scene(out, posed, request, images, deviation, progress)
    for report in reports:
        note(report.line)
