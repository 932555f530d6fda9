"""A calibration: pose of the image relative to a sensor, with covariance and provenance."""

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.geometry import roll_yaw_tilt
from speckle3d.core.sweep import Sweep
from speckle3d.core.text import shown

_ANGLES = {"alpha": "roll (alpha)", "beta": "yaw (beta)", "gamma": "tilt (gamma)"}
_PIXELS = {"s_x": ", columns", "s_y": ", rows"}


def readable(value: float, unit: str) -> tuple[str, str]:
    """Format a number with its unit: angles in degrees, pixel sizes to 10 nm."""
    if unit == "rad":
        return f"{np.rad2deg(value):.3f}", "deg"
    return f"{value:.{5 if unit == 'mm/pixel' else 3}f}", unit


@dataclass(frozen=True)
class Parameter:
    """Estimated parameter with its standard error, which is zero if the parameter was fixed."""

    name: str
    value: float
    standard_error: float
    unit: str

    def row(self) -> tuple[str, str, str]:
        """Name, value with its 95 % interval, and unit, as text."""
        value, unit = readable(self.value, self.unit)
        place = ", phantom" if self.name.endswith("_c") else _PIXELS.get(self.name, "")
        half = readable(1.96 * self.standard_error, self.unit)[0]
        return self.name + place, f"{value} +- {half} (95 %)", unit


@dataclass(frozen=True)
class FramesUsed:
    """Frames used in a calibration, and the reasons for dropping the others.

    Attributes
    ----------
    given : int
        Frames in the recordings.
    used : tuple of int
        Numbers of the frames used, ascending.
    dropped : dict of int to str
        Why each other frame was dropped.
    """

    given: int
    used: tuple[int, ...]
    dropped: dict[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Source:
    """Provenance of a calibration: input file, package version, settings."""

    input_path: str = ""
    input_sha256: str = ""
    package_version: str = ""
    settings_json: str = ""


@shown
@dataclass(frozen=True)
class Calibration:
    """Pose of the image relative to a sensor.

    Parameters
    ----------
    method : str
        ``"plane"``, ``"orientation"``, ``"cross-wire"``, ``"three-wire"``, ``"n-wire"`` or ``"images"``.
    sensor : str
        ``"tracker"`` or ``"orientation"``: which of a sweep's sensors it is for.
    rotation : Rotation
        ``sensor_from_image``, without the translation.
    translation_mm : ndarray, shape (3,), optional
        The image's origin in the sensor's frame; None for an orientation sensor.
    pixel_mm : ndarray, shape (2,), optional
        Distance between columns and between rows, mm, estimated or held; None for an orientation sensor.
    covariance : ndarray, shape (6, 6) or (3, 3)
        Of the image's pose in its own frame: rotations about the image's x, y, z (tilt, yaw, roll) in rad,
        then displacements along them in mm.
    parameters : tuple of Parameter
        All that was estimated, the phantom's own included.
    rms : float
        Root mean square residual, in `rms_unit`.
    rms_unit : str
        "mm", or "deg" where only directions are known.
    condition_number : float
        Of the Jacobian with scaled columns.
    time_offset_s : float, optional
        The sensor's clock offset that was used or found; None where it was neither.
    verdict : str
        One sentence: whether the motion was sufficient.
    frames : FramesUsed
        Which frames were used, and why others were dropped.
    source : Source
        What it was made from.
    """

    method: str
    sensor: str
    rotation: Rotation
    translation_mm: FloatArray | None
    pixel_mm: FloatArray | None
    covariance: FloatArray
    parameters: tuple[Parameter, ...]
    rms: float
    rms_unit: str
    condition_number: float
    frames: FramesUsed
    time_offset_s: float | None = None
    verdict: str = ""
    source: Source = field(default_factory=Source)

    def __post_init__(self) -> None:
        if self.sensor not in ("tracker", "orientation"):
            raise InvalidInputError(f"sensor: expected tracker or orientation, got {self.sensor!r}")
        size = 3 if self.translation_mm is None else 6
        if self.covariance.shape != (size, size):
            raise InvalidInputError(f"covariance: expected shape {(size, size)}, got {self.covariance.shape}")
        if self.pixel_mm is not None and not ((self.pixel_mm > 0) & (self.pixel_mm < np.inf)).all():
            raise InvalidInputError(f"pixel_mm: expected values above zero, got {self.pixel_mm}")

    def rows(self) -> list[tuple[str, str, str]]:
        """Description, value with its 95 % interval, and unit as text, angles in degrees."""
        angles = np.rad2deg(roll_yaw_tilt(self.rotation))
        errors = np.rad2deg(np.sqrt(np.diag(self.covariance)[2::-1]))
        # A reason counts without its details, after a colon or "by", which differ from frame to frame.
        reasons = (reason.split(":")[0].split(" by ")[0] for reason in self.frames.dropped.values())
        offset_s = self.time_offset_s
        return [
            ("method", self.method, ""),
            ("sensor", self.sensor, ""),
            *(parameter.row() for parameter in self.parameters if parameter.name not in _ANGLES),
            *(
                (name, f"{angle:.3f} +- {1.96 * error:.3f} (95 %)", "deg")
                for name, angle, error in zip(_ANGLES.values(), angles, errors, strict=True)
            ),
            ("RMS residual" if self.rms_unit else "correlation lost", *readable(self.rms, self.rms_unit)),
            ("condition number", f"{self.condition_number:.1f}", ""),
            ("frames used", f"{len(self.frames.used)} of {self.frames.given}", ""),
            *(
                (f"dropped: {reason}", str(count), "frame" + "s" * (count > 1))
                for reason, count in Counter(reasons).most_common()
            ),
            *([] if offset_s is None else [("sensor clock offset", f"{offset_s:+.4f}", "s")]),
            ("verdict", self.verdict, ""),
        ]

    @property
    def sensor_from_image(self) -> RigidTransform:
        """Pose of the image in the sensor's frame.

        Raises
        ------
        InsufficientDataError
            If only the rotation is known.
        """
        if self.translation_mm is None:
            raise InsufficientDataError(
                f"expected a calibration with a translation, got one of an orientation sensor ({self.method})"
            )
        return RigidTransform.from_components(self.translation_mm, self.rotation)

    @property
    def mounting(self) -> RigidTransform | Rotation:
        """Calibrated part of the image's pose in its sensor: rotation, or rotation and place."""
        return self.sensor_from_image if self.sensor == "tracker" else self.rotation

    def pixel_matrix(self) -> FloatArray:
        """Affine matrix from pixels (column, row, slice, 1) to the sensor's frame in mm, shape (4, 4).

        The form that PLUS and 3D Slicer call ``ImageToProbe``; a slice is as thick as the average pixel.
        """
        if self.pixel_mm is None:
            raise InsufficientDataError("expected a calibration with a pixel size, got one without")
        scale = [*self.pixel_mm.tolist(), self.pixel_mm.mean(), 1.0]
        return np.asarray(self.sensor_from_image.as_matrix() * scale)


def calibrated(sweep: Sweep, calibration: Calibration) -> Sweep:
    """Replace the mounting of a sweep's sensor by a calibration.

    The sensor's clock offset is replaced if the calibration knows one; the image grid stays as it is.

    Parameters
    ----------
    sweep : Sweep
    calibration : Calibration
        Of one of its sensors.

    Returns
    -------
    Sweep
        With this mounting, and this clock offset if the calibration has one.

    Raises
    ------
    MismatchError
        If the sweep has no such sensor.
    InsufficientDataError
        If it is for a tracker and knows no translation.

    Examples
    --------
    >>> import speckle3d
    >>> sweep = speckle3d.load_sweep("data/phantom.h5")
    >>> held = sweep.orientation
    >>> calibration = Calibration(
    ...     "orientation", "orientation", held.sensor_from_image, None, None, 1e-6 * np.eye(3),
    ...     (), 0.01, "rad", 12.0, FramesUsed(2, (0, 1)), time_offset_s=0.02,
    ... )
    >>> speckle3d.calibrated(sweep, calibration).orientation.time_offset_s
    0.02
    """
    name, offset_s = calibration.sensor, calibration.time_offset_s
    sensor: Any = getattr(sweep, name)
    if sensor is None:
        raise MismatchError(f"{sweep.name}: expected the calibration's sensor, {name}, got none")
    changes: dict[str, Any] = {} if offset_s is None else {"time_offset_s": offset_s}
    if name == "tracker":
        changes["image_skew_rad"] = 0.0
    return replace(sweep, **{name: replace(sensor, sensor_from_image=calibration.mounting, **changes)})
