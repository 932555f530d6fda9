"""Options of compounding that commands share, and the settings they make."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.common import from_options, load_settings

if TYPE_CHECKING:
    from speckle3d.imaging.voxels.settings import CompoundingSettings

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
    return from_options(CompoundingSettings, base | given)
