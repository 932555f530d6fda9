"""The whole configuration: one small model per stage, read from TOML, saved with every result."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path

import tomlkit
from pydantic import BaseModel, ConfigDict
from pydantic.fields import FieldInfo

from speckle3d.core.units import unit_of
from speckle3d.correction.crossing.sweep import CrossingSettings
from speckle3d.correction.drift import DriftSettings
from speckle3d.correction.settings import FusedSettings
from speckle3d.imaging.voxels.settings import CompoundingSettings
from speckle3d.io.toml import load_toml, parsed, validated
from speckle3d.matching.inplane import InPlaneSettings
from speckle3d.matching.intensity import IntensitySettings
from speckle3d.matching.matcher import MatchingSettings
from speckle3d.matching.patches import PatchSettings
from speckle3d.matching.quality import QualitySettings
from speckle3d.matching.schedule import TrajectorySettings
from speckle3d.motion.coherence import CoherenceSettings
from speckle3d.motion.decorrelation import CurveSettings
from speckle3d.motion.direction import SensorSettings
from speckle3d.motion.planes import PlaneSettings

_COMMENT_WIDTH = 100
REMOVED = (("inertial", None), ("fused", "contradiction_sigma"))
"""Groups, and settings of groups, that older reconstructions' configurations hold and nothing reads now."""


class Config(BaseModel):
    """Every setting of a reconstruction, a group for each stage.

    Examples
    --------
    >>> settings = Config(matching={"correlate": "intensity"})
    >>> settings.matching.correlate, settings == config_from_toml(settings.to_toml())
    ('intensity', True)
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    intensity: IntensitySettings = IntensitySettings()
    patches: PatchSettings = PatchSettings()
    inplane: InPlaneSettings = InPlaneSettings()
    matching: MatchingSettings = MatchingSettings()
    curves: CurveSettings = CurveSettings()
    coherence: CoherenceSettings = CoherenceSettings()
    planes: PlaneSettings = PlaneSettings()
    quality: QualitySettings = QualitySettings()
    trajectory: TrajectorySettings = TrajectorySettings()
    sensors: SensorSettings = SensorSettings()
    drift: DriftSettings = DriftSettings()
    crossing: CrossingSettings = CrossingSettings()
    fused: FusedSettings = FusedSettings()
    volume: CompoundingSettings = CompoundingSettings()

    def with_choices(self, consistent_subset: bool | None, drift_curves: str | None) -> Config:
        """Return a configuration with command-line choices in place of its own; None leaves one as it is."""
        values = self.model_dump()
        if consistent_subset is not None:
            values["sensors"]["consistent_subset"] = consistent_subset
        if drift_curves is not None:
            values["drift"]["curves"] = drift_curves
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
    told = f"{field.description} Default {default}{f' {unit}' if unit else ''}."
    return textwrap.wrap(told, _COMMENT_WIDTH)


def config_from_toml(text: str, where: str = "configuration") -> Config:
    """Parse TOML; settings that are not given keep their defaults, and those of older versions are ignored.

    Raises
    ------
    InvalidInputError
        Naming the setting that is unknown or out of range.
    """
    values = parsed(text, where)
    for group, name in REMOVED:
        if name is None:
            values.pop(group, None)
        elif isinstance(values.get(group), dict):
            values[group].pop(name, None)
    return validated(values, where, Config)


def load_config(path: Path) -> Config:
    """Read a configuration from a TOML file; settings that it does not give keep their defaults.

    Parameters
    ----------
    path : path
        TOML file; settings that it does not give keep their defaults.

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
    return load_toml(Config, path)
