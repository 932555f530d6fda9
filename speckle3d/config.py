"""The whole configuration: one small model per stage, read from TOML, saved with every result."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

import tomlkit
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.correction.drift import DriftSettings
from speckle3d.matching.inplane import InPlaneSettings
from speckle3d.matching.intensity import IntensitySettings
from speckle3d.matching.matcher import MatchingSettings
from speckle3d.matching.patches import PatchSettings
from speckle3d.matching.quality import QualitySettings
from speckle3d.matching.schedule import TrajectorySettings
from speckle3d.motion.coherence import CoherenceSettings
from speckle3d.motion.decorrelation import CurveSettings
from speckle3d.motion.planes import PlaneSettings

_Model = TypeVar("_Model", bound=BaseModel)


class SensorSettings(BaseModel):
    """How sensor streams are used."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    consistent_subset: bool = Field(
        True, description="In mode `orientation`, drop distances that the sensed orientation contradicts."
    )
    smooth_s: float = Field(
        0.2,
        ge=0,
        description="Standard deviation of the Gaussian that smooths sensed orientation for the subset.",
    )
    direction: int = Field(
        0,
        ge=-1,
        le=1,
        description="Sign of the first elevational motion; 0: from a sensor, or positive without one.",
    )


class Config(BaseModel):
    """Every setting of a reconstruction."""

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

    def with_choices(self, consistent_subset: bool | None, drift_curves: str | None) -> Config:
        """Return a configuration with command-line choices in place of its own; None leaves one as it is."""
        sensors, drift = self.sensors, self.drift
        if consistent_subset is not None:
            sensors = sensors.model_copy(update={"consistent_subset": consistent_subset})
        if drift_curves is not None:
            drift = _checked(DriftSettings, drift.model_dump() | {"curves": drift_curves}, "drift")
        return self.model_copy(update={"sensors": sensors, "drift": drift})

    def to_toml(self) -> str:
        """Render as TOML text."""
        return tomlkit.dumps(self.model_dump(mode="json"))


def config_from_toml(text: str, where: str = "configuration") -> Config:
    """Parse TOML; settings that are not given keep their defaults.

    Raises
    ------
    InvalidInputError
        Naming the setting that is unknown or out of range.
    """
    try:
        return _checked(Config, tomllib.loads(text), where)
    except tomllib.TOMLDecodeError as error:
        raise InvalidInputError(f"{where}: expected TOML, got an error: {error}") from error


def _checked(model: type[_Model], values: dict[str, Any], where: str) -> _Model:
    """Validate values, naming the first that is wrong in one line."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise InvalidInputError(f"{where}: {name}: {first['msg']}, got {first['input']!r}") from error


def load_config(path: Path) -> Config:
    """Read a configuration file."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise FileError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path}: expected UTF-8 text, got other bytes") from error
    return config_from_toml(text, str(path))
