"""Import settings: metadata that a recording lacks, from options or a TOML file.

The numbers for ``scan.mha`` are looked for in ``scan.mha.toml`` and else in ``import.toml``, which serves
every recording of its folder; those for a folder ``scan`` in ``scan.toml``, ``scan/import.toml``, or
``import.toml`` beside it. Options replace them one by one.
"""

import os
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StrictFloat, field_validator

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.io.toml import load_toml

SPEED_OF_SOUND_M_S = 1540.0
"""Of scanners that do not say theirs."""

_FOLDER_FILE = "import.toml"

Size = Annotated[StrictFloat, Field(gt=0)]
NotNegative = Annotated[StrictFloat, Field(ge=0)]
LEAST_HZ = 1e4
"""Of ultrasound or of its sampling: less is a number in MHz or kHz."""
Hertz = Annotated[StrictFloat, Field(ge=LEAST_HZ)]


class ImportSettings(BaseModel):
    """Values that replace a recording's own, or stand in where it has none.

    Attributes are named as the options of ``speckle3d convert``, and as they are in TOML.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    sampling_rate_hz: Hertz | None = None
    """samples per second along a line, in the scanner's export settings or log"""
    vector_pitch_mm: Size | None = None
    """distance between lines; a linear probe's element pitch, in its data sheet, where each element has \
one line; of lines that spread: array_radius_mm and line_angles_deg"""
    element_pitch_mm: Size | None = None
    """distance between elements of the array, in the probe's data sheet, where the file places its lines \
in elements"""
    array_radius_mm: NotNegative | None = None
    """radius of a curved array's face, in the probe's data sheet; 0: phased array"""
    line_angles_deg: tuple[StrictFloat, StrictFloat] | None = None
    """angles of the first and the last line of a curved or phased array, from straight down"""
    speed_of_sound_m_s: Size | None = None
    """assumed by the scanner; 1540 unless its manual says otherwise"""
    centre_frequency_hz: Hertz | None = None
    """transmit frequency, on the scanner's screen or in the probe's data sheet"""
    bandwidth_hz: tuple[Hertz, Hertz] | None = None
    """lowest and highest frequency of the echoes, at -6 dB in the probe's data sheet"""
    demodulation_frequency_hz: NotNegative | None = None
    """frequency that I/Q were shifted down by, usually the transmit frequency"""
    first_sample_depth_mm: StrictFloat | None = None
    """depth of a line's first sample; 0 unless the scanner records later"""
    column_pitch_mm: Size | None = None
    """distance between columns, from the scanner's depth ruler or --plus-config"""
    row_spacing_mm: Size | None = None
    """distance between rows, from the scanner's depth ruler or --plus-config"""
    dynamic_range_db: Size | None = None
    """decibels from black to white, beside the image on the scanner's screen"""
    frame_rate_hz: Size | None = None
    """frames per second, on the scanner's screen"""
    probe: str | None = None
    """model of the probe, printed on it, for its element pitch; or --element-pitch-mm"""
    tracker_transform: str | None = None
    """poses to use, by their name in the file, as ToolToTracker; none for none"""
    reference_transform: str | None = None
    """poses of the reference, as ReferenceToTracker; none for none"""
    plus_config: str | None = None
    """device set of PLUS, with the place of the image on the probe and the size of its pixels; in TOML, \
from the folder of that file"""
    image_to_probe: tuple[tuple[StrictFloat, ...], ...] | None = None
    """image calibration of PLUS, pixels to mm, four rows of four numbers"""
    arrays: dict[str, str] = {}
    """arrays of a MATLAB file by what they are, as rf = 'RcvData'; of others, data = which"""

    @field_validator("demodulation_frequency_hz")
    @classmethod
    def _is_in_hertz(cls, value: float | None) -> float | None:
        if value and value < LEAST_HZ:
            raise ValueError(f"Input should be 0 or at least {LEAST_HZ:g}")
        return value


class MissingSettingsError(InvalidInputError):
    """A recording lacks required metadata.

    Attributes
    ----------
    settings : tuple of str
        All of them, by their names in `ImportSettings`.
    """

    def __init__(self, path: PathLike | str, settings: tuple[str, ...] = ()) -> None:
        self.settings = settings
        fields, place = ImportSettings.model_fields, Path(path)
        options = "; ".join(f"{option_of(name)} ({fields[name].description})" for name in settings)
        file = f"{_FOLDER_FILE} in it" if place.is_dir() else f"{place.name}.toml beside it"
        request = f"{path}: the file does not say, so give `speckle3d convert` or {file}: {options}"
        super().__init__(request if settings else str(path))


def option_of(name: str) -> str:
    """Option of commands that gives a setting."""
    return f"--{name.removeprefix('tracker_').replace('_', '-')}"


def settings_for(path: PathLike, options: ImportSettings | None = None) -> ImportSettings:
    """Settings beside a recording, with options over them.

    Raises
    ------
    FileError, InvalidInputError
        If the file beside it cannot be read, or holds other settings.
    """
    options = options or ImportSettings()
    if (file := settings_file(path)) is None:
        return options
    settings = load_toml(ImportSettings, file)
    changes = options.model_dump(exclude_unset=True, exclude_none=True)
    if settings.plus_config is not None:
        changes = {"plus_config": str(file.parent / settings.plus_config)} | changes
    return settings.model_copy(update=changes)


def settings_file(path: PathLike) -> Path | None:
    """Find the file that gives what a recording lacks: beside it, or in it if it is a folder."""
    place = Path(os.path.abspath(path))  # of "." and "..", too, with links as they are named
    inside = [place / _FOLDER_FILE] if place.is_dir() else []
    files = [place.with_name(f"{place.name}.toml"), *inside, place.with_name(_FOLDER_FILE)]
    return next((file for file in files if file.is_file()), None)
