"""Read the settings of a mechanism that holds the probe at known orientations from comma-separated text.

::

    # anything after a hash is a comment
    tilt,yaw,roll,time_s,until_s
    -16.4,-5.5,0,12.0,14.5
    -14.5,-5.5,0,17.0,19.5

Angles are in degrees. The columns may be in any order and separated by commas, semicolons, tabs or blanks;
``roll`` may be missing and is then 0; on the sensor's clock, ``time_s`` is when the mechanism came to rest
and ``until_s`` when it left. Without a header the columns are tilt, yaw and, if there is a third, roll.
"""

import re
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.streams import TimedRotations

_COLUMNS = ("tilt", "yaw", "roll", "time", "until")

_AXIS = {"roll": "Z", "yaw": "Y", "tilt": "X"}


@dataclass(frozen=True)
class MechanismSettings:
    """Orientations the mechanism was set to.

    Attributes
    ----------
    base_from_image : Rotation, length n
        The probe's orientation as set, relative to the mechanism's base.
    time_s, until_s : ndarray, shape (n,), optional
        Start and end of the mechanism's standstill, on the sensor's clock; without `until_s` a moment.
    """

    base_from_image: Rotation
    time_s: FloatArray | None = None
    until_s: FloatArray | None = None


def read_mechanism_csv(path: PathLike, turns: str = "roll, yaw, tilt") -> MechanismSettings:
    """Read the settings of a mechanism, one orientation per line.

    Parameters
    ----------
    path : path
        Text as in the module's description.
    turns : str
        The mechanism's axes from its base to the probe: each turn carries the axes after it. The default
        is the convention of the fixed angles, R = Rz(roll) Ry(yaw) Rx(tilt).

    Returns
    -------
    MechanismSettings
        Settings by line, angles in radians.

    Raises
    ------
    FileError
        If the file cannot be read, or is no file.
    InvalidInputError
        With file and line, if the text is not as described.
    """
    sequence = re.split(r"[\s,-]+", turns.strip().lower())
    if sorted(sequence) != sorted(_AXIS):
        raise InvalidInputError(f"turns: expected roll, yaw and tilt in some order, got {turns!r}")
    with open_regular(path) as file:
        text = file.read()
    table = _table(text.decode("utf-8-sig", errors="replace"), str(path))
    angles = [table.get(name, np.zeros(len(table["tilt"]))) for name in sequence]
    order = "".join(_AXIS[name] for name in sequence)
    rotation = Rotation.from_euler(order, np.stack(angles, axis=1), degrees=True)
    start_s, end_s = table.get("time"), table.get("until")
    if start_s is not None and end_s is not None and (less := end_s < start_s).any():
        k = less.argmax()
        expected = f"expected until_s no less than time_s, {start_s[k]:g} s"
        raise InvalidInputError(f"{path}: setting {k + 1}: {expected}, got {end_s[k]:g} s")
    return MechanismSettings(rotation, start_s, end_s)


def readings_at(sensor: TimedRotations, settings: MechanismSettings) -> Rotation:
    """Reading of the sensor for each setting, averaged over the time the mechanism stood still.

    Parameters
    ----------
    sensor : TimedRotations
        Readings of the sensor.
    settings : MechanismSettings
        When the mechanism stood at which angles.

    Returns
    -------
    Rotation
        Rotations at these settings.

    Raises
    ------
    InsufficientDataError
        If the sensor has no reading at the time of a setting, or the settings have no times and their number
        is not that of the readings.
    """
    start_s, count = settings.time_s, len(settings.base_from_image)
    if start_s is None:
        if len(sensor) != count:
            raise InsufficientDataError(
                f"expected times with the {count} settings, or as many readings, got no times and "
                f"{len(sensor)} readings"
            )
        return sensor.world_from_sensor
    end_s = start_s if settings.until_s is None else settings.until_s
    spans = zip(np.searchsorted(sensor.time_s, [start_s, end_s]).T, 0.5 * (start_s + end_s), strict=True)
    return Rotation.concatenate(
        [
            sensor.world_from_sensor[low:high].mean() if high - low > 1 else sensor.at(middle_s)
            for (low, high), middle_s in spans
        ]
    )


def _table(text: str, where: str) -> dict[str, FloatArray]:
    """Columns by name; where semicolons separate, the decimal sign may be a comma."""
    lines = [content for line in text.splitlines() if (content := line.partition("#")[0].strip().lower())]
    if any(";" in line for line in lines):
        lines = [line.replace(",", ".") for line in lines]
    names = ["tilt", "yaw", "roll"]
    if lines and re.match(r"[\"a-z]", lines[0]):
        names = re.findall("|".join(_COLUMNS), lines.pop(0))  # Tilt_deg, tilt/deg and tilt(deg) are all tilt
    try:
        columns = np.array([re.split(r"\s*[;,]\s*|\s+", line) for line in lines], dtype=float).T
    except ValueError as error:
        raise InvalidInputError(f"{where}: expected as many numbers in every line, got others") from error
    table = dict(zip(names, columns, strict=False))
    required = {"tilt", "yaw", "time"} if "until" in table else {"tilt", "yaw"}
    if len(table) != len(columns) or not required <= set(table) or not np.isfinite(columns).all():
        raise InvalidInputError(
            f"{where}: expected settings of tilt and yaw, perhaps roll, time_s and with it until_s, "
            f"got {len(lines)} of {len(columns)} columns"
        )
    return table
