"""Readings of one sensor against the images' path: residuals, derivatives, and the sensor's own unknowns.

A reading of orientation or pose at time t is, but for its jitter,

    world * wander(t) * path(t + late) * (centre from sensor) * mounting

with a tracker's places stretched by its millimetres. The unknowns are small and kept in one vector: turn and
shift of the world, turn and shift of the mounting, clock, log of the millimetres, and the wandering error at
knots in time: a turn of an orientation sensor, a shift of a tracker.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.geometry import rigid, skew
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.correction.image_path import HAND_TURN_RAD, ImagePath, knot_intervals
from speckle3d.correction.settings import FusedSettings

FEWEST_READINGS = 10
PER_PIECE = 512
"""Readings whose equations are held in memory at a time."""
LEAST_JITTER = np.array([2e-5, 2e-3])
"""Of a turn, rad, and a place, mm: the last digits of sensors; simulated ones may have no noise."""
TICK = float(np.sqrt(np.finfo(float).eps))
"""Step of a difference quotient, and inverse deviation of what is not known at all."""
RIGID = 14
"""Unknowns before the wander's: turn and shift of world and mounting, clock, logarithm of millimetres."""


@dataclass(frozen=True)
class SensorReadings:
    """Readings of one sensor, and where its world lies.

    Attributes
    ----------
    centre_from_sensor : RigidTransform
        The mounting, to the image's centre.
    world : RigidTransform
        Sensor's world from the path's, to begin with.
    world_from_sensor : RigidTransform, length m
        Readings; without places of an orientation sensor.
    time_s : ndarray, shape (m,)
        On the images' clock.
    jitter : ndarray, shape (2,)
        Standard deviation of a turn, rad, and of a place, mm, about each axis.
    wander : ndarray, shape (3,)
        Standard deviation along the world's axes of an error that changes in `wander_s`: of an orientation
        sensor's turns, rad, as its settings have it, or of a tracker's places, mm.
    """

    name: str
    places: bool
    centre_from_sensor: RigidTransform
    world: RigidTransform
    world_from_sensor: RigidTransform
    time_s: FloatArray
    frame_time_s: FloatArray
    settings: FusedSettings
    jitter: FloatArray
    wander: FloatArray

    @classmethod
    def of(
        cls,
        sensor: OrientationSensor | Tracker | None,
        path: FloatArray,
        centre_mm: FloatArray,
        frame_time_s: FloatArray,
        settings: FusedSettings,
    ) -> SensorReadings | None:
        """Readings over the frames; None without a sensor, a mounting, or readings enough.

        Parameters
        ----------
        path : ndarray, shape (n, 4, 4)
            Of the image's centre.
        """
        if sensor is None or sensor.sensor_from_image is None:
            return None
        time_s = sensor.readings.time_s + sensor.time_offset_s
        inside = np.flatnonzero((time_s >= frame_time_s[0]) & (time_s <= frame_time_s[-1]))
        if inside.size < FEWEST_READINGS:
            return None
        places = isinstance(sensor, Tracker)
        centre = RigidTransform.from_translation(centre_mm if places else np.zeros(3))
        slow = settings.inclination_sigma_rad, settings.inclination_sigma_rad, settings.heading_sigma_rad
        readings = cls(
            sensor.label,
            places,
            (rigid(sensor.sensor_from_image) * centre).inv(),
            RigidTransform.identity(),
            rigid(sensor.readings.world_from_sensor[inside]),
            time_s[inside],
            frame_time_s,
            settings,
            np.ones(2),
            np.array(slow),
        )
        readings = replace(readings, world=readings._consensus_world(path))
        second = [
            (values[2:] - 2.0 * values[1:-1] + values[:-2]) / np.sqrt(6.0)
            for values in readings.errors(path, np.zeros(readings.size))
        ]
        jitter = [robust_sigma(values, least) for values, least in zip(second, LEAST_JITTER, strict=True)]
        # A random walk departs from the straight line between two knots by a sixth of its growth, on average.
        interval_s = np.ptp(frame_time_s) / knot_intervals(frame_time_s.size)
        unresolved = HAND_TURN_RAD * np.sqrt(interval_s / 6.0)
        lever_mm = np.linalg.norm(readings.centre_from_sensor.translation)
        wander = np.full(3, jitter[1]) if places else readings.wander
        return replace(
            readings, jitter=np.hypot(jitter, unresolved * np.array([1.0, lever_mm])), wander=wander
        )

    @property
    def knots_s(self) -> FloatArray:
        """Times at which the wandering error is unknown."""
        return np.linspace(self.time_s[0], self.time_s[-1], 1 + knot_intervals(self.frame_time_s.size))

    def with_wander(self, unknowns: FloatArray, covariance: FloatArray) -> SensorReadings:
        """A tracker's readings with the likeliest size of its wander; an orientation sensor's is known.

        By the fixed point of MacKay 1992: squares of the knots over how many of them the readings determine.

        Parameters
        ----------
        unknowns : ndarray, shape (size,)
        covariance : ndarray, shape (size, size)
            Of them.

        References
        ----------
        .. [1] D. J. C. MacKay, "Bayesian interpolation", Neural Computation 4(3), 1992.
        """
        if not self.places:
            return self
        residual, root = self.prior(unknowns)
        unobserved = ((root @ covariance) * root).sum(axis=1)[RIGID:]
        ratio = (residual[RIGID:] ** 2).sum() / max((1.0 - unobserved).sum(), TICK)
        return replace(self, wander=np.maximum(self.wander * np.sqrt(ratio), LEAST_JITTER[1]))

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return RIGID + 3 * self.knots_s.size

    def _consensus_world(self, path: FloatArray) -> RigidTransform:
        """The world that most readings agree on."""
        expected = self._expected(path, np.zeros(self.size))
        turns = self.world_from_sensor.rotation * expected.rotation.inv()
        turn = turns[int(np.argmin((turns.mean().inv() * turns).magnitude()))]
        place = np.median(self.world_from_sensor.translation - turn.apply(expected.translation), axis=0)
        return RigidTransform.from_components(place, turn)

    def travel_ratio(self, path: FloatArray) -> float:
        """Ratio of the sensor's travel to the images', along their common path."""
        expected = self._expected(path, np.zeros(self.size)) * self.centre_from_sensor.inv()
        image_path, sensor_path = (
            poses.translation - poses.translation.mean(axis=0)
            for poses in (expected, self.world_from_sensor * self.centre_from_sensor.inv())
        )
        return float((image_path * sensor_path).sum() / max((image_path**2).sum(), LEAST_JITTER[1] ** 2))

    def world_of(self, unknowns: FloatArray) -> RigidTransform:
        """Sensor's world from the path's; it turns about the middle of the readings."""
        pivot = RigidTransform.from_translation(self.world_from_sensor.translation.mean(axis=0))
        turn, shift = unknowns[:6].reshape(2, 3)
        about_pivot = pivot * RigidTransform.from_rotation(Rotation.from_rotvec(turn)) * pivot.inv()
        return RigidTransform.from_translation(shift) * about_pivot * self.world

    def _frames(self, unknowns: FloatArray) -> tuple[IntArray, FloatArray]:
        """The frame before each reading, and the reading's share of the time to the next."""
        time_s, frames = self.time_s + unknowns[12], self.frame_time_s
        before = np.clip(np.searchsorted(frames, time_s, "right") - 1, 0, frames.size - 2)
        return before, (time_s - frames[before]) / np.diff(frames)[before]

    def _expected(self, path: FloatArray, unknowns: FloatArray) -> RigidTransform:
        """What would be read but for wander and wrong millimetres."""
        before, share = self._frames(unknowns)
        poses = RigidTransform.from_matrix(path)
        step = (poses[:-1].inv() * poses[1:]).as_exp_coords()[before]
        between = poses[before] * RigidTransform.from_exp_coords(step * share[:, None])
        turn, shift = unknowns[6:12].reshape(2, 3)
        mounting = RigidTransform.from_components(shift, Rotation.from_rotvec(turn))
        return self.world_of(unknowns) * between * self.centre_from_sensor * mounting

    def _hats(self) -> FloatArray:
        """Weights of the wander's knots at each reading, shape (m, k)."""
        away = np.abs(self.time_s[:, None] - self.knots_s)
        return np.maximum(1.0 - away / np.diff(self.knots_s)[:1], 0.0)

    def errors(self, path: FloatArray, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Expected less measured turns, rad, and places, mm, along the world's axes, shape (m, 3) each."""
        expected = self._expected(path, unknowns)
        turn = (expected.rotation * self.world_from_sensor.rotation.inv()).as_rotvec()
        wander = self._hats() @ unknowns[RIGID:].reshape(-1, 3)
        if not self.places:
            return turn + wander, np.zeros_like(turn)
        place = expected.translation
        stretch = unknowns[13] * (place - place.mean(axis=0))
        return turn, place + stretch + wander - self.world_from_sensor.translation

    def equations(
        self, path: ImagePath, coefficients: FloatArray, unknowns: FloatArray
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Residuals over their jitter, shape (k, 3), and derivatives, shape (k, 3, columns), in pieces.

        The columns are the path's coefficients, then the sensor's unknowns. A turn, or a place, is a row.
        """
        poses = path.chain.poses(coefficients)
        errors = np.stack(self.errors(poses, unknowns))
        expected, rigid = self._expected(poses, unknowns), np.zeros((*errors.shape, RIGID))
        place = expected.translation - self.world_from_sensor.translation.mean(axis=0)
        rigid[0, :, :, 0:3] = rigid[1, :, :, 3:6] = np.eye(3)
        rigid[1, :, :, 0:3] = -skew(place)
        rigid[0, :, :, 6:9] = rigid[1, :, :, 9:12] = expected.rotation.as_matrix()
        later = self.errors(poses, unknowns + TICK * np.eye(self.size)[12])
        rigid[..., 12] = (np.stack(later) - errors) / TICK
        rigid[1, :, :, 13] = place - place.mean(axis=0)
        world, hats = self.world_of(unknowns), self._hats()
        to_world, on_path = world.rotation.as_matrix(), world.inv() * expected
        twists, (before, share) = path.chain.twists(coefficients, poses), self._frames(unknowns)
        for first in range(0, self.time_s.size, PER_PIECE):
            rows = slice(first, first + PER_PIECE)
            at, part = before[rows], share[rows, None, None]
            turn, shift = (twist[at] * (1.0 - part) + twist[at + 1] * part for twist in twists)
            moves = turn, shift - skew(on_path.translation[rows]) @ turn
            wander = np.einsum("mk,ij->mikj", hats[rows], np.eye(3)).reshape(len(at), 3, -1)
            for kind in range(1 + self.places):
                own = [rigid[kind, rows], wander if kind == self.places else 0.0 * wander]
                slopes = np.concatenate([to_world @ moves[kind], *own], axis=-1)
                yield errors[kind, rows] / self.jitter[kind], slopes / self.jitter[kind]

    def prior(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals of what is known of mounting, clock, millimetres and wander, and their derivatives."""
        s = self.settings
        mounting = [*[s.mounting_sigma_rad] * 3, *[s.mounting_sigma_mm] * 3]
        rigid = 1.0 / np.array([*[1.0 / TICK] * 6, *mounting, s.clock_sigma_s, s.tracker_scale_sigma])
        k = self.knots_s.size
        matrix = np.zeros((self.size, self.size))
        matrix[range(RIGID), range(RIGID)] = rigid
        decay = np.exp(-np.diff(self.knots_s)[:1] / s.wander_s)
        change = np.eye(k) - decay * np.eye(k, k=-1)
        change[1:] /= np.sqrt(1.0 - decay**2)
        matrix[RIGID:, RIGID:] = np.kron(change, np.diag(1.0 / self.wander))
        return matrix @ unknowns, matrix
