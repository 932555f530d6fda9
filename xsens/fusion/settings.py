"""Engines that find an orientation, and settings of the filter: properties of sensors, hands and rooms."""

import math
from dataclasses import dataclass
from enum import StrEnum

from scipy.constants import g

from speckle3d.core.errors import InvalidInputError

_DEG = math.pi / 180.0

BRIDGED_S = 0.1
"""The longest pause that is integrated over: a hand's rate changes little in it (tremor: below 12 Hz)."""

LOST = 1.5
"""A step longer than so many usual ones holds lost samples."""


# A frozen dataclass like DeviceSettings and Hints, not a pydantic model: xsens stands without pydantic.
@dataclass(frozen=True)
class FusionSettings:
    """Parameters of the orientation filter, all of them measurable properties.

    Attributes
    ----------
    block_s : float
        Length of the increments the filter runs on: short against hand movement (tremor is below 12 Hz).
    gravity_m_s2 : float
        Standard gravity; local gravity differs by 0.3 % at most and an accelerometer by more.
    gyro_noise_rad_sqrt_s : float
        Angle random walk. 0.05 deg/sqrt(s) is an MT9-B's Allan deviation at 1 s; newer sensors have a tenth.
    gyro_scale_noise_sqrt_s : float
        Error of the gyroscope's scale and axes, a fraction of the turn: 0.4 % persisting for a swing of
        about 0.25 s, ``0.004 sqrt(2 * 0.25)``.
    bias_walk_rad_s_sqrt_s : float
        Random walk of the bias, 0.002 deg/s/sqrt(s): 0.05 deg/s in ten minutes.
    bias_sd_rad_s : float
        Bias at switching on, 1 deg/s.
    speed_m_s, speed_time_s : float
        Standard deviation of a hand's speed about its mean, zero, and how long a speed persists.
    force_noise_m_s_sqrt_s : float
        Velocity random walk of the accelerometer, misalignment in quick movement included.
    moving_bias_rad_s : float
        How far the bias in movement is from that at rest, 0.05 deg/s: an error of half the gyroscope's
        resolution at rest, acceleration and vibration.
    magnetometer_lag_s : float
        Standard deviation of the magnetometer's delay behind the gyroscope: a chip that averages readings
        and sends them at a lower rate is 10 to 20 ms late.
    field_noise_sqrt_s : float
        Noise of the magnetometer, as a fraction of the field's norm.
    field_first_place, field_place : float
        What a place adds to the room's field, as a fraction of its norm, per component: 5 %, or 8 degrees of
        heading where the field dips by 68 degrees, but 1 % where north is found at first.
    rest_rate_rad_s, rest_force_m_s2, rest_after_s : float
        The sensor rests if for the last of these neither reading differs by more from its mean of half a
        second.
    rest_bias_rad_s : float
        A resting sensor's rate differs from the bias by no more (beyond 3 sd of the bias): slower, steady
        turning is taken for bias.
    use_magnetometer : bool
        Without it the heading starts at zero and only the gyroscope carries it.

    Raises
    ------
    InvalidInputError
        If a number is not positive and finite.
    """

    block_s: float = 1.0 / 32.0
    gravity_m_s2: float = g
    gyro_noise_rad_sqrt_s: float = 0.05 * _DEG
    gyro_scale_noise_sqrt_s: float = 0.003
    bias_walk_rad_s_sqrt_s: float = 0.002 * _DEG
    bias_sd_rad_s: float = 1.0 * _DEG
    speed_m_s: float = 0.5
    speed_time_s: float = 0.5
    force_noise_m_s_sqrt_s: float = 0.01
    moving_bias_rad_s: float = 0.05 * _DEG
    magnetometer_lag_s: float = 0.015
    field_noise_sqrt_s: float = 0.002
    field_first_place: float = 0.01
    field_place: float = 0.05
    rest_rate_rad_s: float = 1.0 * _DEG
    rest_force_m_s2: float = 0.3
    rest_after_s: float = 1.5
    rest_bias_rad_s: float = 0.2 * _DEG
    use_magnetometer: bool = True

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isinstance(value, bool) and not (math.isfinite(value) and value > 0.0):
                raise InvalidInputError(f"{name}: expected a positive number, got {value!r}")


class Method(StrEnum):
    """Engine of an orientation; `smoother` and `vqf` use the readings after each sample as well."""

    smoother = "smoother"
    filter = "filter"
    vqf = "vqf"
    vqf_online = "vqf-online"

    @classmethod
    def _missing_(cls, value: object) -> None:
        raise InvalidInputError(f"method: expected {', '.join(cls)}, got {value!r}")

    @property
    def offline(self) -> bool:
        """Whether readings after a sample tell of its orientation."""
        return self in (Method.smoother, Method.vqf)

    @property
    def is_vqf(self) -> bool:
        """Whether VQF finds the orientation, not this package's filter."""
        return self in (Method.vqf, Method.vqf_online)
