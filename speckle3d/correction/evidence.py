"""What else tells a sensor's motion: the images it rides on, its own gyroscope, gravity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.geometry import components
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.kernels.steps import Readings, steps_of_readings

_SHORT_S = 0.3
"""A hand's wobble and tremor turn round within this time, which is what fixes a clock."""
_MOST_STEPS = 300
"""Steps compared over one lag: more of them overlap and tell nothing new."""
_FEWEST_STEPS = 5
_MIRRORED = np.array([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
"""Signs by which a step changes if the probe moved the other way; see `speckle3d.core.geometry.mirrored`."""

_WANDER_MM, _WANDER_DEG = 0.05, 0.06
"""Honest sensors wander by about this over `_SHORT_S`, and by more with the root of the time."""
_SCALE_ERROR = 0.05
"""Share of a step by which images and sensors may honestly differ: scale and mounting."""
_ELEVATION_RANGE = (0.85, 1.18)
"""Elevational scale is left free within what curves of another probe do to it."""
_TURN_DEG, _TURN_SHARE = 0.7, 0.3
"""Images know tilt and yaw no better than this: between patches an image's width apart they are slopes."""
_WANDERING = 6
"""Independent values in what a sweep's images and a tracker differ by: drift bends it a few times."""
_MEDIAN_SQUARE = 0.455
"""Median of the square of a standard normal deviate."""


@dataclass(frozen=True)
class Agreement:
    """How well a sensor's steps over one lag fit the images', an entry for each of x, y, z, tilt, yaw, roll.

    An orientation sensor has the last three alone. Standard deviations are robust, in mm and degrees. Several
    sensors' may be stacked.

    Attributes
    ----------
    left : ndarray, shape (..., c)
        Of sensor less images.
    seen : ndarray, shape (..., c)
        Of the images' steps.
    noise : ndarray, shape (..., c)
        What honest sensors and images leave.
    steps : ndarray, shape (...)
        Number of independent ones.
    """

    left: FloatArray
    seen: FloatArray
    noise: FloatArray
    steps: FloatArray

    @property
    def misfit(self) -> FloatArray:
        """Negative logarithm of the likelihood of normal residuals, their variance estimated."""
        return np.asarray(self.steps * np.log(self.left**2 + self.noise**2).sum(axis=-1))

    def __getitem__(self, one: int) -> Agreement:
        return Agreement(self.left[one], self.seen[one], self.noise[one], self.steps[one])


@dataclass(frozen=True)
class _Lag:
    first: IntArray
    second: IntArray
    steps: FloatArray
    independent: float
    seconds: float


class MotionEvidence:
    """Motion of the image's centre between frames some way apart, as the images or a tracker have it.

    In-plane motion and roll are measured on speckle that both frames show; tilt and yaw are known roughly;
    the sign of the elevational motion is open, and with it those of tilt and yaw.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
    centre_mm : ndarray, shape (3,)
    image : RigidTransform, length n
        Poses of the image.
    by_images : bool
        Whether the poses are from images; if not, from a tracker, which knows every turn and every sign.
    """

    def __init__(
        self, time_s: FloatArray, centre_mm: FloatArray, image: RigidTransform, by_images: bool = True
    ) -> None:
        self.time_s, self.centre_mm, self.image, self.by_images = time_s, centre_mm, image, by_images
        n, pause = len(image), float(np.median(np.diff(time_s)))
        longest = max(2, n // 3)
        lags = {int(np.clip(round(_SHORT_S / pause), 2, longest)), max(2, n // 5), longest}
        self.lags = [self._lag(lag, pause) for lag in sorted(lags) if lag < n]
        turned = (image.rotation.mean().inv() * image.rotation).as_rotvec(degrees=True)
        self._jitter = np.concatenate([np.zeros(3), [_jitter(column) for column in turned.T]])

    def _lag(self, lag: int, pause_s: float) -> _Lag:
        n = len(self.image)
        count = min(n - lag, _MOST_STEPS)
        first = np.unique(np.linspace(0, n - 1 - lag, count).round().astype(int))
        steps = steps_between(self.image[first], self.image[first + lag], self.centre_mm)
        return _Lag(first, first + lag, steps, (n - lag) / lag, lag * pause_s)

    def agreements(self, sensor: OrientationSensor | Tracker, noise: FloatArray) -> list[Agreement]:
        """How a sensor's steps fit, over each lag that it covers, at the sign that fits better.

        Parameters
        ----------
        sensor : OrientationSensor or Tracker
            Calibrated to the image.
        noise : ndarray, shape (6,)
            `noise_of` the sensor as it was recorded: a fault put right must not look better for being small.
        """
        signs = self._agreements([sensor], noise, False)
        return [each[0] for each in signs[int(np.argmin([total_misfit(some)[0] for some in signs]))]]

    def misfits(
        self, sensors: Sequence[OrientationSensor | Tracker], noise: FloatArray, still: bool = False
    ) -> FloatArray:
        """Mean misfit of each of several sensors, that are read at the same times, as of its `agreements`.

        Parameters
        ----------
        still : bool
            Instead, how a sensor that does not move would fit.
        """
        ahead, back = self._agreements(sensors, noise, still)
        return np.minimum(total_misfit(ahead), total_misfit(back))

    def _agreements(
        self, sensors: Sequence[OrientationSensor | Tracker], noise: FloatArray, still: bool
    ) -> tuple[list[Agreement], list[Agreement]]:
        """Of all sensors, stacked, over each lag that they cover, if the probe moved forward, and back."""
        every = [self._sensed(sensor) for sensor in sensors]
        signs: tuple[list[Agreement], list[Agreement]] = [], []
        for number, lag in enumerate(self.lags):
            sensed = np.stack([each[number] for each in every])
            if np.isfinite(sensed[0, :, -1]).sum() >= _FEWEST_STEPS:
                both = self._both_signs(0.0 * sensed if still else sensed, noise, lag)
                for agreements, agreement in zip(signs, both, strict=True):
                    agreements.append(agreement)
        return signs

    def delayed_misfits(
        self, sensor: OrientationSensor | Tracker, noise: FloatArray, delays_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Misfit per independent step over the shortest lag, were the sensor's motion that much earlier.

        Parameters
        ----------
        delays_s : ndarray, shape (k,)

        Returns
        -------
        misfit, steps : ndarray, shape (k,)
            NaN where the sensor covers too few frames; and how many independent steps there are.
        """
        lag, misfit, steps = self.lags[0], np.full(delays_s.size, np.nan), np.zeros(delays_s.size)
        first, second = (self.time_s[frames] + delays_s[:, None] for frames in (lag.first, lag.second))
        sensed = _steps_at(sensor, first, second, self.centre_mm)
        enough = np.isfinite(sensed[..., -1]).sum(axis=1) >= _FEWEST_STEPS
        if enough.any():
            both = self._both_signs(sensed[enough], noise, lag)
            steps[enough] = both[0].steps
            misfit[enough] = np.minimum(both[0].misfit, both[1].misfit) / steps[enough]
        return misfit, steps

    def turn(self, sensor: OrientationSensor | Tracker, noise: FloatArray, sign: int) -> Rotation:
        """Rotation of the image on the sensor that best maps the images' steps to the sensor's."""
        sensed, seen = [], []
        for lag, every in zip(self.lags, self._sensed(sensor), strict=True):
            covered = np.isfinite(every[:, -1])
            if covered.sum() < _FEWEST_STEPS:
                continue
            measured, columns = every[covered], every.shape[1]
            images = lag.steps[covered, -columns:] * (_MIRRORED[-columns:] if sign < 0 else 1.0)
            for axes in (slice(0, 3), slice(-3, None))[-(columns // 3) :]:
                weight = 1.0 / (noise[-columns:][axes].max() * np.sqrt(lag.second[0] - lag.first[0]))
                sensed.append(measured[:, axes] * weight)
                seen.append(images[:, axes] * weight)
        if not seen:
            return Rotation.identity()
        left, _, right = np.linalg.svd(np.concatenate(sensed).T @ np.concatenate(seen))
        proper = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
        return Rotation.from_matrix(left @ proper @ right)

    def elevational_scale(self, tracker: Tracker) -> tuple[float, float]:
        """Travel along the first image's z over the images' own, and its standard error.

        Both paths are compared over the whole sweep, where jitter counts least; the error is from what is
        left, which wanders: some `_WANDERING` independent values.
        """
        covered = np.flatnonzero(tracker.covers(self.time_s))
        sensed = _elevation(tracker.world_from_image(self.time_s[covered]), self.centre_mm)
        seen = _elevation(self.image[covered], self.centre_mm)
        power = float(np.sum(seen**2))
        if covered.size < _FEWEST_STEPS or power == 0:
            return float("nan"), float("inf")
        scale = float(np.sum(sensed * seen)) / power
        spread = float(np.std(sensed - scale * seen))
        return abs(scale), spread * float(np.sqrt(covered.size / (_WANDERING * power)))

    def _sensed(self, sensor: OrientationSensor | Tracker) -> list[FloatArray]:
        """Steps over each lag as a sensor has them, shape (m, c); NaN where it has not."""
        first, second = (
            np.concatenate([getattr(lag, at) for lag in self.lags]) for at in ("first", "second")
        )
        steps = _steps_at(sensor, self.time_s[first], self.time_s[second], self.centre_mm)
        return np.split(steps, np.cumsum([lag.first.size for lag in self.lags])[:-1])

    def _both_signs(self, sensed: FloatArray, noise: FloatArray, lag: _Lag) -> tuple[Agreement, Agreement]:
        """How steps, shape (k, m, c), fit the images' if the probe moved forward, and if it moved back."""
        columns = sensed.shape[-1]
        covered = np.isfinite(sensed[..., -1])
        forward = np.where(covered[..., None], lag.steps[:, -columns:], np.nan)
        size = _spread(forward)
        wander = np.sqrt(lag.seconds / _SHORT_S) * np.array([_WANDER_MM] * 3 + [_WANDER_DEG] * 3)[-columns:]
        turning = np.zeros_like(size)
        if self.by_images:
            turning[:, -3:-1] = np.hypot(_TURN_DEG, _TURN_SHARE * size[:, -3:-1])
        parts = (noise[-columns:], self._jitter[-columns:], wander, turning, _SCALE_ERROR * size)
        expected = np.sqrt(sum(np.square(part) for part in parts))
        independent = 1.0 + covered.mean(axis=1) * max(lag.independent, 0.0)

        def fit(seen: FloatArray) -> Agreement:
            left = sensed - seen
            if columns == 6:
                power = np.nansum(seen[..., 2] ** 2, axis=1)
                scale = np.nansum(sensed[..., 2] * seen[..., 2], axis=1)
                scale = np.divide(scale, power, out=np.ones_like(power), where=power > 0)
                scale = np.clip(scale, *_ELEVATION_RANGE)[:, None]
                left[..., 2] = sensed[..., 2] - scale * seen[..., 2]
            return Agreement(_spread(left), size, expected, independent)

        ahead = fit(forward)
        return ahead, fit(forward * _MIRRORED[-columns:]) if self.by_images else ahead


def total_misfit(agreements: list[Agreement]) -> FloatArray:
    """Mean misfit over the lags, which share their information; zero without any."""
    return np.asarray(np.mean([each.misfit for each in agreements], axis=0) if agreements else np.zeros(1))


def noise_of(sensor: OrientationSensor | Tracker, time_s: FloatArray, centre_mm: FloatArray) -> FloatArray:
    """Jitter of a step of the image's centre, shape (6,): x, y, z in mm, then tilt, yaw, roll in degrees."""
    poses = sensor.world_from_image(time_s[sensor.covers(time_s)])
    turned = poses.rotation if isinstance(poses, RigidTransform) else poses
    degrees = _jitter((turned.mean().inv() * turned).as_rotvec(degrees=True))
    millimetres = _jitter(poses.apply(centre_mm)) if isinstance(poses, RigidTransform) else 0.0
    return np.array([millimetres] * 3 + [degrees] * 3) + 1e-3


@dataclass(frozen=True)
class GyroscopeEvidence:
    """How turns of the readings fit those of the sensor's own gyroscope over 0.3 s, in degrees by axis.

    Attributes
    ----------
    left, measured : ndarray, shape (3,)
        Standard deviation of gyroscope less readings, and of the gyroscope's turns.
    bias : float
        Rate by which the gyroscope turns on the whole and the readings do not, or the other way, deg/s.
    noise, steps : float
        As in `Agreement`.
    """

    left: FloatArray
    measured: FloatArray
    bias: float
    noise: float
    steps: float

    @property
    def misfit(self) -> float:
        """As `Agreement.misfit`."""
        return float(self.steps * np.log(self.left**2 + self.noise**2).sum())

    @property
    def confirms(self) -> bool:
        """Whether the sensor turned enough to tell, and its readings turned with it."""
        tells = self.measured > 2.0 * self.noise
        return bool(tells.any() and np.sum(self.left[tells] ** 2) < 0.3 * np.sum(self.measured[tells] ** 2))


def gyroscope_evidence(sensor: OrientationSensor) -> GyroscopeEvidence | None:
    """Compare readings with the gyroscope; None without one, or with too few readings."""
    rate, time_s, turned = sensor.gyroscope_rad_s, sensor.readings.time_s, sensor.readings.world_from_sensor
    if rate is None or len(turned) < 20:
        return None
    pause = np.diff(time_s)
    lag = max(1, round(_SHORT_S / float(np.median(pause))))
    if len(turned) <= 2 * lag:
        return None
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum((rate[1:] + rate[:-1]) / 2 * pause[:, None], axis=0)])
    first = np.unique(np.linspace(0, len(turned) - 1 - lag, _MOST_STEPS).round().astype(int))
    first = first[time_s[first + lag] - time_s[first] < 2.0 * _SHORT_S]
    if first.size < _FEWEST_STEPS:
        return None
    integrated = np.rad2deg(angle[first + lag] - angle[first])
    read = (turned[first].inv() * turned[first + lag]).as_rotvec(degrees=True)
    left = integrated - read
    measured = _spread(integrated - np.median(integrated, axis=0))
    noise = 0.1 + _SCALE_ERROR * float(measured.max())
    drift = np.median(left, axis=0)
    bias = float(np.linalg.norm(drift) / np.median(time_s[first + lag] - time_s[first]))
    return GyroscopeEvidence(_spread(left - drift), measured, bias, noise, len(turned) / lag)


def gravity_from_vertical(sensor: OrientationSensor) -> float | None:
    """Angle between gravity, as the readings turn it, and the world's z, degrees; None if not measured."""
    force = sensor.accelerometer_m_s2
    if force is None:
        return None
    up = np.median(sensor.readings.world_from_sensor.apply(force), axis=0)
    size = float(np.linalg.norm(up))
    return float(np.degrees(np.arccos(min(1.0, abs(float(up[2])) / size)))) if size > 0 else None


def steps_between(
    first: RigidTransform | Rotation, second: RigidTransform | Rotation, centre_mm: FloatArray
) -> FloatArray:
    """Motion from first to second places, seen from the first.

    Returns
    -------
    ndarray, shape (m, 6) or (m, 3)
        x, y, z of the image's centre in mm, where places are known, and tilt, yaw, roll in degrees.
    """
    if isinstance(first, RigidTransform) and isinstance(second, RigidTransform):
        step = first.inv() * second
        return np.hstack([step.apply(centre_mm) - centre_mm, step.rotation.as_rotvec(degrees=True)])
    turns = [each.rotation if isinstance(each, RigidTransform) else each for each in (first, second)]
    return np.asarray((turns[0].inv() * turns[1]).as_rotvec(degrees=True))


def _steps_at(
    sensor: OrientationSensor | Tracker, first_s: FloatArray, second_s: FloatArray, centre_mm: FloatArray
) -> FloatArray:
    """`steps_between` the images at two times each, as a sensor has them, shape (..., 6) or (..., 3).

    NaN where the sensor does not cover both.
    """
    covered = sensor.covers(first_s) & sensor.covers(second_s)
    first, second = (
        np.where(covered, each - sensor.time_offset_s, np.nan).ravel() for each in (first_s, second_s)
    )
    assert sensor.sensor_from_image is not None
    mounting = components(sensor.sensor_from_image)
    readings, steps = (
        Readings(sensor.readings.time_s, *sensor.readings.components, *mounting),
        np.empty((first_s.size, 6)),
    )
    steps_of_readings(readings, centre_mm, first, second, steps)
    columns = 6 if isinstance(sensor, Tracker) else 3
    return steps.reshape(*first_s.shape, 6)[..., -columns:]


def _elevation(poses: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Place of the image's centre along the first image's z, less its mean."""
    z_mm = (poses[0].inv() * poses).apply(centre_mm)[:, 2]
    return np.asarray(z_mm - z_mm.mean())


def _spread(values: FloatArray) -> FloatArray:
    """Root mean square by column, from the median: a tenth of wild values does not move it.

    Of shape (..., m, c) to (..., c); NaN are passed over.
    """
    squares = np.sort(np.swapaxes(values, -1, -2) ** 2, axis=-1)  # NaN come last
    count = np.isfinite(squares).sum(axis=-1)[..., None]
    middle = [np.take_along_axis(squares, at, axis=-1)[..., 0] for at in ((count - 1) // 2, count // 2)]
    return np.asarray(np.sqrt((middle[0] + middle[1]) / 2.0 / _MEDIAN_SQUARE))


def _jitter(path: FloatArray) -> float:
    """Standard deviation of a difference of two readings, from second differences, free of slow motion."""
    if len(path) < 3:
        return 0.0
    return float(np.sqrt(2.0 / 6.0)) * robust_sigma(path[2:] - 2.0 * path[1:-1] + path[:-2])
