"""Error-state Kalman filter of orientation, which advances by short increments.

Error state, 13: attitude (world axes, z the heading), gyroscope bias as estimated without the magnetometer
(sensor axes), velocity (world axes), gyroscope bias as estimated with it, and the angle between the local
field's heading and north. Two copies of one bias keep magnetism out of inclination: the magnetometer corrects
heading and the second copy alone (a Schmidt filter, which accounts for the states it leaves uncorrected),
every other observation corrects both. Without a magnetometer the second copy is unused.

This is the filter of samples as they arrive, and the statement of what the filter is. Recordings run through
`speckle3d.kernels.orientation`, the same arithmetic without objects; tests hold the two together.

The accelerometer is integrated to velocity, which stays near zero in a hand: over many swings that shows the
direction of gravity in spite of movement, where the accelerometer itself shows it only at rest. The attitude
error is the invariant one (velocity turns with it), so that errors of heading and velocity stay separate.

References
----------
.. [1] F. L. Markley, "Attitude error representations for Kalman filtering", J. Guid. Control Dyn., 2003.
.. [2] A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE TAC, 2017.
.. [3] D. Laidig, T. Seel, "VQF: Highly accurate IMU orientation estimation with bias estimation and magnetic
   disturbance rejection", Information Fusion, 2023 (gates, rest detection).
"""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import KalmanFilter

from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import skew
from xsens.fusion.detectors import FieldMonitor, RestDetector
from xsens.fusion.increments import Increment, turn_matrix
from xsens.fusion.settings import FusionSettings

SIZE = 13
ANGLE, BIAS, SPEED, HEADING_BIAS = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
HEADING, STRAY = 2, 12

START_S = 1.0
"""Inclination and heading at the start are those of the mean force and field over this time."""

REST_SPEED_M_S = 0.02
REST_TIME_S = 0.5
"""Standard deviation of a resting sensor's velocity, and how long the accelerometer's error persists."""

REST_BIAS_RAD = math.radians(0.03)
"""Error of the bias after one second of rest: an MT9-B's Allan deviation at 1 s is 0.05 deg/s."""

REST_NOISE = 0.1
"""Random walk of a resting sensor's attitude, as a fraction of the gyroscope's. The gyroscope is not
integrated at rest; this allows for turning too slow to notice."""


class ErrorStateFilter:
    """Estimate orientation from increments. The world is x magnetic north, y west, z up."""

    def __init__(self, settings: FusionSettings, first: Increment) -> None:
        """Start before `first`, with its bias; `first` must then be given to `advance`."""
        self.settings = settings
        self._magnetic = settings.use_magnetometer
        self._start: _Start | None = _Start()
        self._point(first)
        self.velocity = np.zeros(3)
        self.bias = first.bias_rad_s.copy()
        self._heading_bias = self.bias.copy()
        self.resting = self.disturbed = False
        self._rest = RestDetector(settings)
        self._monitor = FieldMonitor(settings)
        self._stray = 0.0
        self.kalman = KalmanFilter(dim_x=SIZE, dim_z=3)
        self.kalman.P = start_covariance(settings)
        self.transition = np.eye(SIZE)

    @property
    def started(self) -> bool:
        """Whether the first second, which finds the direction of up, is over."""
        return self._start is None

    def resume(self, increment: Increment, pause_s: float) -> None:
        """Find up and north again after a pause before `increment`; keep bias and reference field."""
        fresh = start_covariance(self.settings)
        walk = self.settings.bias_walk_rad_s_sqrt_s**2 * pause_s
        for row in (BIAS, HEADING_BIAS):
            for column in (BIAS, HEADING_BIAS):
                fresh[row, column] = self.kalman.P[row, column]
        fresh[BIAS, BIAS] += walk * np.eye(3)
        fresh[HEADING_BIAS, HEADING_BIAS] += walk * np.eye(3)
        self.kalman.P = fresh
        self._start, self._stray = _Start(), 0.0
        self._point(increment)
        self._rest = RestDetector(self.settings)

    def _point(self, first: Increment) -> None:
        """Set up and north from one increment alone."""
        self._level, self._heading = _upright(first.velocity_m_s), 0.0
        if first.field_au is not None and self._magnetic:
            field = self._level @ first.field_au
            self._heading = -math.atan2(field[1], field[0])

    @property
    def matrix(self) -> FloatArray:
        """World from sensor, shape (3, 3)."""
        return _about_up(self._heading) @ self._level

    @property
    def heading_bias(self) -> FloatArray:
        """Gyroscope bias, shape (3,), by all observations."""
        return self._heading_bias if self._magnetic else self.bias

    @property
    def sd_rad(self) -> FloatArray:
        """Standard deviation of the attitude about the world's axes, shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.kalman.P)[ANGLE]))

    def advance(self, increment: Increment) -> None:
        """Predict over one increment and correct by its observations."""
        bias_sd = math.sqrt(max(float(np.diag(self.kalman.P)[BIAS].max()), 0.0))
        self.resting = self._rest.rests(increment, self.bias, bias_sd)
        before = self._level
        self._predict(increment)
        self.predicted = self._level, self.velocity
        if self._start is not None:
            self._begin(increment)
            return
        self._correct_velocity(increment.duration_s)
        if self.resting:
            self._correct_bias(increment)
        if increment.field_au is not None and self._magnetic:
            self._correct_heading(before @ increment.field_au, increment)

    def _begin(self, increment: Increment) -> None:
        """Set up from the mean force since the start, and north from the mean field."""
        start = self._start
        assert start is not None
        start.add(increment)
        self._level = start.level()
        self.velocity = np.zeros(3)
        over = start.duration_s >= START_S
        self._start = None if over else start
        if start.field_s > 0.0 and self._magnetic:
            field = self._level @ start.field()
            self._heading = -math.atan2(field[1], field[0])
            if over:
                self._correct_heading(field, increment)

    # -- prediction

    def _predict(self, increment: Increment) -> None:
        duration = increment.duration_s
        lever = self._level * duration
        self.transition = self._transition_of(lever, duration)
        self.noise = self._noise(increment)
        self.kalman.predict(F=self.transition, Q=self.noise)
        self._stray *= self.transition[STRAY, STRAY]
        self._heading += float(lever[HEADING] @ (self.bias - self.heading_bias))
        self.velocity = self.velocity + self._level @ increment.velocity_m_s
        self.velocity[2] -= self.settings.gravity_m_s2 * duration
        if not self.resting:  # a resting sensor is known not to turn, better than its gyroscope knows
            correction = turn_matrix((increment.bias_rad_s - self.bias) * duration)
            self._level = self._level @ increment.turn @ correction

    def _transition_of(self, lever: FloatArray, duration: float) -> FloatArray:
        gravity = self.settings.gravity_m_s2
        transition = np.eye(SIZE)
        if not self.resting:
            transition[STRAY, STRAY] = 1.0 - duration / self.settings.field_place_s
            transition[:HEADING, BIAS] = -lever[:HEADING]
            transition[HEADING, HEADING_BIAS if self._magnetic else BIAS] = -lever[HEADING]
            transition[SPEED, BIAS] = -skew(self.velocity) @ lever
        transition[6, 1], transition[7, 0] = gravity * duration, -gravity * duration
        return transition

    def _noise(self, increment: Increment) -> FloatArray:
        s, duration = self.settings, increment.duration_s
        rate = math.hypot(*(increment.rate_rad_s - self.bias))
        turning = s.gyro_noise_rad_sqrt_s**2 + (s.gyro_scale_noise_sqrt_s * rate) ** 2
        if self.resting:
            turning = (REST_NOISE * s.gyro_noise_rad_sqrt_s) ** 2
        noise = np.zeros((SIZE, SIZE))
        walk = s.bias_walk_rad_s_sqrt_s**2 * duration
        i = np.arange(3)
        noise[i, i] = turning * duration
        noise[i + 3, i + 3] = walk
        if self._magnetic:
            if not self.resting:
                noise[STRAY, STRAY] = 2.0 * s.field_sd_rad**2 / s.field_place_s * duration
            noise[i + 9, i + 9] = noise[i + 3, i + 9] = noise[i + 9, i + 3] = walk
        noise[i + 6, i + 6] = s.force_noise_m_s_sqrt_s**2 * duration
        return noise

    # -- correction

    def _correct_velocity(self, duration: float) -> None:
        """Correct by a velocity of zero, whose error is a hand's, or smaller at rest, and persists."""
        s = self.settings
        variance = 2.0 * s.speed_m_s**2 * s.speed_time_s
        if self.resting:
            variance = 2.0 * REST_SPEED_M_S**2 * REST_TIME_S
        self.kalman.update(-self.velocity[:, None], R=variance / duration, H=_OBSERVES_SPEED)
        self._inject()

    def _correct_bias(self, increment: Increment) -> None:
        """Correct both copies of the bias, one by one, by the gyroscope's reading at rest."""
        variance = REST_BIAS_RAD**2 / increment.duration_s * np.eye(3)
        tilt = increment.rate_rad_s - self.bias
        if not self._magnetic:
            self._masked_update(_OBSERVES_BIAS, tilt, variance, np.ones(SIZE))
            return
        self._masked_update(_OBSERVES_BIAS, tilt, variance, _INCLINATION)
        heading = increment.rate_rad_s - self.heading_bias
        self._masked_update(_OBSERVES_HEADING_BIAS, heading, variance, _HEADING_ONLY)

    def _correct_heading(self, field: FloatArray, increment: Increment) -> None:
        s, duration = self.settings, increment.duration_s
        rate = math.hypot(*(increment.rate_rad_s - self.bias))
        reading = self._monitor.read(self._level, field, rate, duration)
        self.disturbed = reading.disturbed
        if reading.restart_au is not None:
            self._doubt_heading(reading.restart_au)
        x, y, z = reading.world_au.tolist()
        horizontal = x * x + y * y
        if reading.disturbed or horizontal == 0.0:
            return
        residual = _wrapped(-math.atan2(y, x) - self._heading - self._stray)
        shows = np.zeros((1, SIZE))
        shows[0, :3] = -z * x / horizontal, -z * y / horizontal, 1.0
        shows[0, STRAY] = 1.0
        variance = s.field_noise_rad_sqrt_s**2 + 2.0 * s.field_off_s * reading.variance_rad2
        variance /= duration
        self._masked_update(shows, np.array([residual]), np.array([[variance]]), _HEADING_ONLY)

    def _doubt_heading(self, room_au: FloatArray) -> None:
        """Correct a heading found beside iron, if it is far from that of the room's field."""
        place = self.settings.field_sd_rad**2
        residual = _wrapped(-math.atan2(room_au[1], room_au[0]) - self._heading - self._stray)
        if residual**2 > 9.0 * (self.kalman.P[HEADING, HEADING] + place):
            self.kalman.P[HEADING, HEADING] += residual**2
            self._masked_update(_OBSERVES_NORTH, np.array([residual]), np.array([[place]]), _HEADING_ONLY)

    def _masked_update(
        self, shows: FloatArray, residual: FloatArray, variance: FloatArray, mask: FloatArray
    ) -> None:
        """Correct the states of `mask` alone (Schmidt); the errors of the others count as noise."""
        kalman = self.kalman
        cross = kalman.P @ shows.T
        gain = mask[:, None] * np.linalg.solve(shows @ cross + variance, cross.T).T
        keep = np.eye(SIZE) - gain @ shows
        kalman.P = keep @ kalman.P @ keep.T + gain @ variance @ gain.T
        kalman.x = (gain @ residual)[:, None]
        self._inject()

    def _inject(self) -> None:
        """Apply the estimated error to the state and reset it to zero."""
        error = self.kalman.x[:, 0]
        angle = error[ANGLE].copy()
        if self._magnetic:
            self._heading = _wrapped(self._heading + float(angle[HEADING]))
            angle[HEADING] = 0.0
        turn = turn_matrix(angle)
        self._level = turn @ self._level
        self.velocity = turn @ self.velocity + error[SPEED]
        self.bias = self.bias + error[BIAS]
        self._heading_bias = self._heading_bias + error[HEADING_BIAS]
        self._stray += float(error[STRAY])
        self.kalman.x = np.zeros((SIZE, 1))


class _Start:
    """Mean force and field of the first increments."""

    def __init__(self) -> None:
        self.duration_s = self.field_s = 0.0
        self._turn = np.eye(3)  # first axes from the present ones
        self._force, self._field = np.zeros(3), np.zeros(3)

    def add(self, increment: Increment) -> None:
        """Add the next increment."""
        self._force = self._force + self._turn @ increment.velocity_m_s
        if increment.field_au is not None:
            self._field = self._field + self._turn @ increment.field_au * increment.duration_s
            self.field_s += increment.duration_s
        self._turn = self._turn @ increment.turn
        self.duration_s += increment.duration_s

    def level(self) -> FloatArray:
        """Rotation from the sensor's to level axes at the end of the last increment."""
        return _upright(self._force) @ self._turn

    def field(self) -> FloatArray:
        """Mean field, in the sensor's axes at the end of the last increment."""
        return self._field @ self._turn / self.field_s


def _upright(force: FloatArray) -> FloatArray:
    """The shortest rotation that takes `force` to up."""
    norm = float(np.linalg.norm(force))
    up = force / norm if norm > 0.0 else np.array([0.0, 0.0, 1.0])
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-9:
        return np.diag([1.0, math.copysign(1.0, cosine), math.copysign(1.0, cosine)])
    return turn_matrix(axis / sine * math.atan2(sine, cosine))


def _observer(states: slice) -> FloatArray:
    matrix = np.zeros((3, SIZE))
    matrix[:, states] = np.eye(3)
    return matrix


_OBSERVES_SPEED, _OBSERVES_BIAS = _observer(SPEED), _observer(BIAS)
_OBSERVES_HEADING_BIAS = _observer(HEADING_BIAS)
_OBSERVES_NORTH = np.zeros((1, SIZE))
_OBSERVES_NORTH[0, [HEADING, STRAY]] = 1.0
_HEADING_ONLY = np.zeros(SIZE)
_HEADING_ONLY[[HEADING, 9, 10, 11, STRAY]] = 1.0
_INCLINATION = 1.0 - _HEADING_ONLY


def start_covariance(settings: FusionSettings) -> FloatArray:
    """Covariance at the start: the heading is unknown, both copies of the bias are one."""
    covariance = np.zeros((SIZE, SIZE))
    heading = math.pi if settings.use_magnetometer else 1e-6  # without, it starts at zero by definition
    i = np.arange(3)
    tilt = (2.0 * settings.speed_m_s / (settings.gravity_m_s2 * START_S)) ** 2
    covariance[i, i] = tilt, tilt, heading**2
    bias = settings.bias_sd_rad_s**2
    covariance[i + 3, i + 3] = bias
    if settings.use_magnetometer:
        covariance[STRAY, STRAY] = settings.field_sd_rad**2
        covariance[i + 9, i + 9] = covariance[i + 3, i + 9] = covariance[i + 9, i + 3] = bias
    covariance[i + 6, i + 6] = (2.0 * settings.speed_m_s) ** 2
    return covariance


def _about_up(angle_rad: float) -> FloatArray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _wrapped(angle_rad: float) -> float:
    return math.remainder(angle_rad, 2.0 * math.pi)
