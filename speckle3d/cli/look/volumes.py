"""Voxels of a reconstructed or tracked sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from speckle3d.cli.calibrations import files_of
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import Json, MaybeNumber, MaybePath, MaybeText, Out, Paths, Written, emit_json, note
from speckle3d.cli.look.compounding import (
    Imported,
    clip_of,
    compounding_settings,
    open_sweep_at,
    statement,
)
from speckle3d.cli.outputs import require_own_places
from speckle3d.core.progress import progress_bar

Three = tuple[float, float, float]


def volume(
    input_file: Path,
    out: Out,
    *,
    mode: MaybeText = None,
    settings: Annotated[
        dict[str, Any],
        Fields("speckle3d.imaging.voxels.settings:CompoundingSettings"),
    ],
    axes: Literal["sweep", "world", "principal"] = "sweep",
    spacing_mm: Three | None = None,
    origin_mm: Three | None = None,
    shape: tuple[int, int, int] | None = None,
    size_mm: Three | None = None,
    within_gb: MaybeNumber = None,
    like: MaybePath = None,
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
        The finest round one of a volume no larger than this. Not with --voxel-mm or --spacing-mm.
    like
        A volume whose grid to take. Not with --voxel-mm.
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
    from speckle3d.core.region import Region
    from speckle3d.study.pose_errors import caution
    from speckle3d.study.scenes.voxels import GridRequest, VolumeRequest, write_voxels

    inputs = (input_file, sweep_file, like, *files_of(imported, calibration))
    require_own_places({"--output": out, "--state": state, "--deviation": deviation}, "volume", *inputs)
    checked = compounding_settings(config_file, settings)
    stated = statement(
        input_file, sweep_file, imported, transform, calibration, settings.get("dynamic_range_db")
    )
    (posed,) = open_sweep_at([mode], input_file, stated)
    region = region or clip_of(input_file, stated, posed)
    request = VolumeRequest(
        out,
        checked,
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
