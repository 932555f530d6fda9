"""Options of compounding that commands share, and the settings they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.common import from_options, load_settings, note
from speckle3d.cli.importing import given_settings

if TYPE_CHECKING:
    from speckle3d.imaging.voxels.settings import CompoundingSettings
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.study.posed import PosedSweep

VoxelMm = Annotated[float | None, typer.Option(help="Side of a voxel (0.2).")]
Splat = Annotated[
    str | None, typer.Option(help="nearest: the voxel a sample lies in; linear: the eight around it.")
]
Rule = Annotated[
    str | None,
    typer.Option(
        help="Of a voxel's samples: mean, maximum, latest, weighted; plus: mean kept in whole grey levels as "
        "PLUS and 3D Slicer keep it, to compare with their volumes."
    ),
]
FillRadius = Annotated[int | None, typer.Option(help="Voxels across which holes are filled (3); 0: none.")]
LevelRange = Annotated[float | None, typer.Option(help="Range of log-compressed grey levels (60).")]


def compounding_settings(config_file: Path | None, options: Mapping[str, Any]) -> CompoundingSettings:
    """Group `volume` of a configuration, with the options of its names that were given in its place."""
    from speckle3d.imaging.voxels.settings import CompoundingSettings

    base = load_settings(config_file).volume.model_dump()
    given = {name: value for name, value in options.items() if value is not None}
    if given.get("levels") == "linear" and base["voxel_type"] == "uint8":
        given.setdefault("voxel_type", "float32")  # amplitudes may be less than one, or thousands
    return from_options(CompoundingSettings, base | given)


def open_sweep_at(modes: Sequence[str | None], source: Path, options: Mapping[str, Any]) -> list[PosedSweep]:
    """Open a sweep at the poses of each mode, and say on stderr which frames have none.

    Parameters
    ----------
    modes : sequence of str or None
        At least one; None for the usual one.
    source : path
    options : mapping of str to object
        All options of the command.
    """
    from speckle3d.study.posed import open_posed

    others = said_of(source, options)
    opened = [open_posed(source, mode, *others) for mode in modes]
    recorded = [] if opened[0].reconstruction is not None else recording_notes(source, others[1])
    for line in (*recorded, *opened[0].notes()):
        note(line)
    return opened


def recording_notes(source: Path, settings: ImportSettings) -> list[str]:
    """What is to be told of a recording's images and poses; nothing where a calibration gives its pixels."""
    from speckle3d.io.import_settings import MissingSettingsError
    from speckle3d.io.load import import_notes

    ranged = settings.model_copy(
        update={"dynamic_range_db": 60.0}
    )  # of which grey levels as stored need none
    with suppress(MissingSettingsError):
        return [line for line in import_notes(source, ranged) if not line.startswith("dynamic range")]
    return []


def clip_of(source: Path, options: Mapping[str, Any], posed: PosedSweep) -> str | None:
    """Region of the images that a device set of PLUS clips volumes to; None without one."""
    from speckle3d.io.import_settings import settings_for
    from speckle3d.io.plus.device_set import read_device_set

    config = settings_for(source, said_of(source, options)[1]).plus_config
    clip = None if config is None else read_device_set(config).clip
    grid = replace(posed.sweep.grid, skew_rad=posed.skew_rad)
    return None if clip is None else clip.region_text(grid)


def said_of(
    source: Path, options: Mapping[str, Any]
) -> tuple[Path | None, ImportSettings, Sequence[Path], float | None]:
    """What options say of a sweep, as `open_posed` takes it: file, settings, calibrations, range in dB."""
    # The range is that of the levels that are made, and of B-mode that says none of its own.
    imported = given_settings(source, {**options, "dynamic_range_db": None})
    return options["sweep_file"], imported, options["calibration"] or (), options["dynamic_range_db"]
