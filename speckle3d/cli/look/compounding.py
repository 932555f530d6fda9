"""A sweep at poses, opened with what options say of it; settings of compounding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from speckle3d.cli.calibrations import given_settings
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import from_options, load_settings, notes

if TYPE_CHECKING:
    from speckle3d.imaging.voxels.settings import CompoundingSettings
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.study.posed import PosedSweep

    Statement = tuple[Path | None, ImportSettings, Sequence[Path], float | None]

_IMPORTED = ("plus_config", "reference_transform", "column_pitch_mm", "row_spacing_mm", "frame_rate_hz")
Imported = Annotated[dict[str, Any], Fields("speckle3d.io.import_settings:ImportSettings", _IMPORTED)]
"""Options of what a recording does not say; the range of its grey levels is that of the levels made."""


def compounding_settings(config_file: Path | None, options: Mapping[str, Any]) -> CompoundingSettings:
    """Group `volume` of a configuration, with the options that were given in its place."""
    from speckle3d.imaging.voxels.settings import CompoundingSettings

    base = load_settings(config_file).volume.model_dump()
    if options.get("levels") == "linear" and base["voxel_type"] == "uint8":
        base["voxel_type"] = "float32"  # amplitudes may be less than one, or thousands
    return from_options(CompoundingSettings, base | dict(options))


def statement(
    source: Path,
    sweep_file: Path | None,
    imported: Mapping[str, Any],
    transform: str | None,
    calibration: Sequence[Path] | None,
    dynamic_range_db: float | None,
) -> Statement:
    """What options say of a sweep, as `open_posed` takes it: file, settings, calibrations, range in dB."""
    return sweep_file, given_settings(source, imported, transform), calibration or (), dynamic_range_db


def open_sweep_at(modes: Sequence[str | None], source: Path, stated: Statement) -> list[PosedSweep]:
    """Open a sweep at the poses of each mode (None: the best), and say on stderr which frames have none."""
    from speckle3d.study.posed import open_posed

    opened = [open_posed(source, mode, *stated) for mode in modes]
    recorded = [] if opened[0].reconstruction is not None else recording_notes(source, stated[1])
    notes((*recorded, *opened[0].notes()))
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


def clip_of(source: Path, stated: Statement, posed: PosedSweep) -> str | None:
    """Region of the images that a device set of PLUS clips volumes to; None without one."""
    from speckle3d.io.import_settings import settings_for
    from speckle3d.io.plus.device_set import read_device_set

    config = settings_for(source, stated[1]).plus_config
    clip = None if config is None else read_device_set(config).clip
    grid = replace(posed.sweep.grid, skew_rad=posed.skew_rad)
    return None if clip is None else clip.region_text(grid)
