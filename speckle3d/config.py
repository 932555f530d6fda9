"""The whole configuration: one small model per stage, read from TOML, saved with every result."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import Any

import tomlkit
from pydantic.fields import FieldInfo

from speckle3d.core.errors import InvalidInputError
from speckle3d.correction.crossing.sweep import CrossingSettings
from speckle3d.correction.drift import DriftSettings
from speckle3d.correction.settings import FusedSettings
from speckle3d.imaging.voxels.settings import CompoundingSettings
from speckle3d.io.toml import parsed, read_toml, validated
from speckle3d.matching.matcher import ImageSettings
from speckle3d.matching.schedule import TrajectorySettings
from speckle3d.motion.phantom import CurveSettings
from speckle3d.motion.planes import PlaneSettings
from speckle3d.motion.sensors import SensorSettings

_COMMENT_WIDTH = 100
_UNITS = {
    "_mm": "mm",
    "_rad": "rad",
    "_deg": "degrees",
    "_s": "s",
    "_hz": "Hz",
    "_db": "dB",
    "_gb": "GB",
    "_m_s": "m/s",
    "_m_s2": "m/s^2",
    "_deg_s": "degrees/s",
    "_rad_s": "rad/s",
    "_deg_per_mm": "degrees/mm",
}
"""Units of quantities, by how their names end."""
REMOVED_SETTINGS = {
    "curves.straighten": "measured curves stay as they are, and a data sheet's lens is always fitted",
    "coherence": "echoes are always adapted to, patch by patch over at least 10 mm of travel",
    "inplane.interpolate": "correlations are always read between samples",
    "inplane.passes": "lags are centred twice",
    "trajectory.block_frames": "a sweep is matched in one go",
    "trajectory.revisit_mm": "ties between visits of the same tissue brought them no nearer to each other",
    "trajectory.join": "poses are always solved from all pairs",
    "volume.max_file_gb": "volumes are made in memory, which `max_memory_gb` limits",
    "quality.drop_db": "frames without contact are told by what is in them",
    "inertial": "`fused` takes any sensor there is, `crossed` a second sweep across the first",
    "fused.contradiction_sigma": "where images and sensors differ both numbers are told",
}
"""Settings, or whole stages, of older files, and what is there instead."""


class Config(ImageSettings):
    """Every setting of a reconstruction, a group for each stage.

    Examples
    --------
    >>> settings = Config(matching={"correlate": "intensity"})
    >>> settings.matching.correlate, settings == config_from_toml(settings.to_toml())
    ('intensity', True)
    """

    curves: CurveSettings = CurveSettings()
    planes: PlaneSettings = PlaneSettings()
    trajectory: TrajectorySettings = TrajectorySettings()
    sensors: SensorSettings = SensorSettings()
    drift: DriftSettings = DriftSettings()
    crossing: CrossingSettings = CrossingSettings()
    fused: FusedSettings = FusedSettings()
    volume: CompoundingSettings = CompoundingSettings()

    def with_choices(self, drift_curves: str | None = None, region: str | None = None) -> Config:
        """Return a configuration with command-line choices in place of its own; None leaves one as it is."""
        values = self.model_dump()
        values["drift"]["curves"] = drift_curves or self.drift.curves
        values["patches"]["region"] = self.patches.region if region is None else region
        return validated(values, "configuration", Config)

    def to_toml(self, comments: bool = False) -> str:
        """Write every setting as TOML text, which `config_from_toml` reads back.

        Parameters
        ----------
        comments : bool
            Put before each setting what it is, its unit and its default.
        """
        values = self.model_dump(mode="json")
        if not comments:
            return tomlkit.dumps(values)
        document = tomlkit.document()
        for stage, settings in values.items():
            table = tomlkit.table()
            for name, field in type(getattr(self, stage)).model_fields.items():
                for line in _comment(name, field):
                    table.add(tomlkit.comment(line))
                table.add(name, settings[name])
            document.add(stage, table)
        return tomlkit.dumps(document)


def _comment(name: str, field: FieldInfo) -> list[str]:
    """Lines of what a setting is, its unit and its default."""
    unit, default = unit_of(name), json.dumps(field.default)
    text = f"{field.description} Default {default}{f' {unit}' if unit else ''}."
    return textwrap.wrap(text, _COMMENT_WIDTH)


def config_from_toml(text: str, where: str = "configuration") -> Config:
    """Parse TOML; settings that are not given keep their defaults.

    Raises
    ------
    InvalidInputError
        Naming the setting that is unknown, removed or out of range.
    """
    values = parsed(text, where)
    for name in _obsolete_names(values):
        raise InvalidInputError(f"{where}: {name} was removed: {REMOVED_SETTINGS[name]}")
    return validated(values, where, Config)


def stored_config(text: str) -> Config:
    """Parse the configuration that a file was made with, whose removed settings no longer matter."""
    values = parsed(text, "configuration")
    for name in _obsolete_names(values):
        *stage, setting = name.split(".")
        del (values[stage[0]] if stage else values)[setting]
    return validated(values, "configuration", Config)


def _obsolete_names(values: dict[str, Any]) -> list[str]:
    """Names of stages and settings that older versions had."""
    groups = ((stage, group) for stage, group in values.items() if isinstance(group, dict))
    names = [*values, *(f"{stage}.{name}" for stage, group in groups for name in group)]
    return [name for name in names if name in REMOVED_SETTINGS]


def load_config(path: Path | None = None) -> Config:
    """Read a configuration from a TOML file; settings that it does not give keep their defaults.

    Parameters
    ----------
    path : path, optional
        TOML file; without one all settings have their defaults.

    Returns
    -------
    Config

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the setting that is unknown or out of range.
    """
    return config_from_toml(read_toml(path), str(path)) if path else Config()


def unit_of(name: str) -> str:
    """Unit of a quantity that carries it at the end of its name; empty for a pure number.

    Examples
    --------
    >>> unit_of("voxel_mm"), unit_of("speed_of_sound_m_s"), unit_of("frames")
    ('mm', 'm/s', '')
    """
    fits = [end for end in _UNITS if name.endswith(end)]
    return _UNITS[max(fits, key=len)] if fits else ""
