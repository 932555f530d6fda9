"""The whole configuration: one small model per stage, read from TOML, saved with every result."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

import tomlkit
from pydantic import BaseModel, ConfigDict, ValidationError

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.files import open_regular
from speckle3d.correction.crossing.sweep import CrossingSettings
from speckle3d.correction.drift import DriftSettings
from speckle3d.correction.fused.fuse import FusedSettings
from speckle3d.correction.inertial.settings import InertialSettings
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

Model = TypeVar("Model", bound=BaseModel)
_MOST_BYTES = 2**20
"""A hundred times what every setting takes."""


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
    inertial: InertialSettings = InertialSettings()
    fused: FusedSettings = FusedSettings()

    def with_choices(self, consistent_subset: bool | None, drift_curves: str | None) -> Config:
        """Return a configuration with command-line choices in place of its own; None leaves one as it is."""
        values = self.model_dump()
        if consistent_subset is not None:
            values["sensors"]["consistent_subset"] = consistent_subset
        if drift_curves is not None:
            values["drift"]["curves"] = drift_curves
        return _validated(values, "configuration", Config)

    def to_toml(self) -> str:
        """Write every setting as TOML text, which `config_from_toml` reads back."""
        return tomlkit.dumps(self.model_dump(mode="json"))


def config_from_toml(text: str, where: str = "configuration") -> Config:
    """Parse TOML; settings that are not given keep their defaults.

    Raises
    ------
    InvalidInputError
        Naming the setting that is unknown or out of range.
    """
    return _validated(_parsed(text, where), where, Config)


def _parsed(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InvalidInputError(f"{where}: expected TOML, got brackets within brackets without end") from None
    # Of TOML, and of numbers with thousands of digits.
    except ValueError as error:
        raise InvalidInputError(f"{where}: expected TOML, got an error: {error}") from error


def first_fault(error: ValidationError) -> tuple[str, str]:
    """Return the name of the first setting that is wrong, and what is wrong with it."""
    first = error.errors()[0]
    return ".".join(str(part) for part in first["loc"]), f"{first['msg']}, got {first['input']!r}"


def _validated(values: dict[str, Any], where: str, model: type[Model]) -> Model:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        name, fault = first_fault(error)
        raise InvalidInputError(f"{where}: {f'{name}: ' if name else ''}{fault}") from error


def load_config(path: Path) -> Config:
    """Read a configuration from a TOML file; settings that it does not give keep their defaults.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the setting that is unknown or out of range.
    """
    return load_toml(Config, path)


def load_toml(model: type[Model], path: Path) -> Model:
    """Read settings of any model from a TOML file, as `load_config` does."""
    try:
        with open_regular(path) as stream:
            content = stream.read(_MOST_BYTES + 1)
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path}: expected UTF-8 text, got other bytes") from error
    if len(content) > _MOST_BYTES:
        raise FileError(f"{path}: expected at most {_MOST_BYTES} bytes of TOML, got more")
    return _validated(_parsed(text, str(path)), str(path), model)
