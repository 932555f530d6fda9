"""Errors of an orientation sensor: in the angles between frames, against a reference, and in its whole angle.

Of rotations between frames neither a heading offset nor the choice of north matters, so that the worlds of
sensor and reference may differ.

References
----------
.. [1] R. J. Housden et al., "Calibration of an orientation sensor for freehand 3D ultrasound and its use in a
   hybrid acquisition system", BioMedical Engineering OnLine, 2008, "Assessing calibration precision and
   reconstruction accuracy", table 2.
"""

import re
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.streams import TimedRotations
from speckle3d.core.text import shown

ANGLES = ("roll", "yaw", "tilt")
"""Turns about the image's z, y and x, in this order everywhere."""

ENOUGH_FRAMES = 77
"""Frames taken from a recording unless told otherwise: as many as orientations in [1]_."""

_MOUNTING_LIMIT = np.deg2rad(2.0)
"""Smallest rotation about the second axis (RMS, between frames) that determines a mounting: a sensor good to
half a degree leaves an error of a quarter of a radian at this limit."""


@shown
@dataclass(frozen=True)
class PairErrors:
    """Angles between the frames of every pair by the reference, and the errors of the sensor's angles.

    Attributes
    ----------
    frames : int
        Number n of orientations; pairs are in the order of ``np.triu_indices(n, 1)``: 0 1, 0 2 and so on.
    reference_rad : ndarray, shape (p, 3)
        Roll, yaw and tilt of the second frame seen from the first, about the pair's mean z, y and x.
    error_rad : ndarray, shape (k, p, 3)
        Measured angles less the reference's, for every calibration.
    """

    frames: int
    reference_rad: FloatArray
    error_rad: FloatArray

    def __len__(self) -> int:
        """Number of errors: pairs times calibrations."""
        return self.error_rad.size // 3

    def statistics(self) -> dict[str, FloatArray]:
        """Statistics over all pairs and calibrations: roll, yaw and tilt in radians, by name.

        The mean is the error that grows from earlier frames to later ones: a pair taken the other way round
        has the opposite error, so it depends on the order of the frames, and the RMS does not. The deviation
        with the calibration is that of a pair's errors from their mean over the calibrations, zero if there
        is only one.
        """
        errors = self.error_rad.reshape(-1, 3)
        return {
            "mean": errors.mean(axis=0),
            "standard deviation": errors.std(axis=0),
            "RMS": np.sqrt(np.square(errors).mean(axis=0)),
            "largest": np.abs(errors).max(axis=0),
            "standard deviation with the calibration": np.sqrt(self.error_rad.var(axis=0).mean(axis=0)),
        }


def pair_errors(
    world_from_sensor: Rotation, reference_from_image: Rotation, sensor_from_image: Rotation
) -> PairErrors:
    """Compare the angles between all pairs of frames, with every calibration.

    The angles are the components of the rotation vector from one frame to the other, which are the same in
    the axes of either frame and of the frame half-way between them.

    Parameters
    ----------
    world_from_sensor : Rotation, length n
        The sensor's reading for each frame.
    reference_from_image : Rotation, length n
        The reference's orientation of the same frames, in any world at rest.
    sensor_from_image : Rotation, single or length k
        Calibrations of the sensor.

    Returns
    -------
    PairErrors
        Degrees, by calibration and pair.

    Raises
    ------
    MismatchError
        If there is not one reading per reference.
    InsufficientDataError
        If there are fewer than two frames.

    Examples
    --------
    A sensor that measures 10.5 degrees of tilt for 10:

    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from xsens import pair_errors
    >>> measured, true = (Rotation.from_euler("x", [[0.0], [tilt]], degrees=True) for tilt in (10.5, 10.0))
    >>> roll, yaw, tilt = np.rad2deg(pair_errors(measured, true, Rotation.identity()).error_rad[0, 0])
    >>> round(float(tilt), 6)
    0.5
    """
    matrices = sensor_from_image.as_matrix().reshape(-1, 3, 3)
    turns, reference = _turns(world_from_sensor, reference_from_image)
    # (S C)^-1 (T C) = C^-1 (S^-1 T) C turns by the rotation vector of S^-1 T in the image's axes, so that
    # each pair's rotation vector is computed once for all calibrations.
    angles = np.einsum("kji,pj->kpi", matrices, turns)
    # Of the two turns to the same orientation, the nearer to the reference's: near half a turn a small error
    # changes which is shorter.
    size = np.linalg.norm(angles, axis=-1, keepdims=True)
    longer = (angles * (angles - reference)).sum(axis=-1, keepdims=True) > np.pi * size
    errors = angles * (1.0 - longer * 2.0 * np.pi / np.maximum(size, 1e-12)) - reference
    return PairErrors(len(world_from_sensor), reference[:, ::-1], errors[..., ::-1])


def common_readings(
    sensor: TimedRotations,
    reference: TimedRotations,
    sensor_offset_s: float = 0.0,
    frames: int = ENOUGH_FRAMES,
) -> tuple[Rotation, Rotation]:
    """Readings of sensor and reference at the same moments, evenly spread over the time that both cover.

    Parameters
    ----------
    sensor, reference : TimedRotations
        Each on its own clock.
    sensor_offset_s : float
        A reading taken at sensor time t belongs to reference time t + `sensor_offset_s`.
    frames : int
        Number of moments; they are samples of the reference, so that only the sensor is interpolated.

    Returns
    -------
    sensor, reference : Rotation, length m
        With m = `frames`, or as many as there are.

    Raises
    ------
    InsufficientDataError
        If fewer than two of the reference's samples are covered by the sensor's.
    """
    times_s = reference.time_s - sensor_offset_s
    common = np.flatnonzero(sensor.covers(times_s))
    if common.size < 2:
        raise InsufficientDataError(
            f"expected at least 2 samples of the reference covered by the sensor's, got {common.size}: the "
            f"reference spans {reference.time_s[0]:.3f} to {reference.time_s[-1]:.3f} s, the sensor "
            f"{sensor.time_s[0]:.3f} to {sensor.time_s[-1]:.3f} s and {sensor_offset_s:g} s later"
        )
    sample = common[np.unique(np.linspace(0, common.size - 1, frames).round().astype(int))]
    return sensor.at(times_s[sample]), reference.world_from_sensor[sample]


def mounting_from_motion(measured: Rotation, reference: Rotation) -> Rotation:
    """Rotation between two rigidly joined bodies, one measured by each: ``reference_from_image``.

    For a reference whose axes are not the image's and are not calibrated, such as an optical target: the
    turns between frames of the two bodies differ by the mounting only, which is found by least squares over
    all pairs. It absorbs a constant calibration error of the sensor.

    Parameters
    ----------
    measured : Rotation, length n
        ``world_from_image`` by the sensor, with one calibration.
    reference : Rotation, length n
        ``world_from_target`` by the reference; ``reference * mounting`` is then the image's.

    Returns
    -------
    Rotation
        ``reference_from_image``.

    Raises
    ------
    InsufficientDataError
        If the frames turn about one axis only, or hardly at all.
    """
    image, target = _turns(measured, reference)
    _, second, _ = np.sqrt(np.linalg.eigvalsh(target.T @ target / len(target)).clip(0.0))
    if second < _MOUNTING_LIMIT:
        raise InsufficientDataError(
            f"expected turns about two axes, {np.rad2deg(_MOUNTING_LIMIT):.0f} degrees RMS between frames, "
            f"got {np.rad2deg(second):.2g} about the second: the motion does not tell how the reference is "
            "mounted"
        )
    return Rotation.align_vectors(target, image)[0]


def _turns(measured: Rotation, reference: Rotation) -> tuple[FloatArray, FloatArray]:
    """Rotation vectors between the frames of all pairs by each, in the axes of the body, shape (p, 3)."""
    n = len(measured)
    if len(reference) != n:
        raise MismatchError(f"expected one reference per reading, got {len(reference)} and {n}")
    if n < 2:
        raise InsufficientDataError(f"expected at least 2 orientations, got {n}")
    first, second = np.triu_indices(n, 1)
    turns, truth = ((poses[first].inv() * poses[second]).as_rotvec() for poses in (measured, reference))
    return turns, truth


# -- a mechanism as the reference

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
    """Read the settings of a mechanism that holds the probe at known orientations, one per line.

    ::

        # anything after a hash is a comment
        tilt,yaw,roll,time_s,until_s
        -16.4,-5.5,0,12.0,14.5
        -14.5,-5.5,0,17.0,19.5

    Angles are in degrees. The columns may be in any order and separated by commas, semicolons, tabs or
    blanks; ``roll`` may be missing and is then 0; on the sensor's clock, ``time_s`` is when the mechanism
    came to rest and ``until_s`` when it left. Without a header the columns are tilt, yaw and, if there is a
    third, roll.

    Parameters
    ----------
    path : path
        Comma-separated text as above.
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
        raise InvalidInputError(
            f"{path}: setting {k + 1}: expected until_s from time_s on, {start_s[k]:g} s, got {end_s[k]:g} s"
        )
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
