"""What a sensor says: readings of the image's pose or orientation, with jitter, wander and a mounting."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.geometry import adjoint
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.correction.fused.images import pose_columns
from speckle3d.correction.fused.problem import Block

LEAST_JITTER_RAD, LEAST_JITTER_MM = 2e-5, 2e-3
"""No reading is better, whatever its neighbours say: a thousandth of a degree, two micrometres."""
OUTLYING = 2.5
"""Root mean square of a reading's residuals, over their standard deviations, from which it loses weight: five
standard deviations of three honest residuals."""
KNOTS_S, MOST_KNOTS = 0.4, 24
"""A wandering error is a straight line between knots so far apart, or as far as that many knots allow."""
FEWEST_READINGS = 10
"""With fewer readings over the frames a sensor is left out: its jitter would be unknown."""


@dataclass(frozen=True)
class SensorState:
    """Variables of one sensor.

    Attributes
    ----------
    world : RigidTransform
        ``world_from_first``: of the first frame, about the image's centre. For an orientation sensor only
        its rotation counts.
    mounting : ndarray, shape (3,) or (6,)
        Twist by which the image is elsewhere on the sensor than given, in the sensor's axes.
    late_s : float
        By which the sensor's clock is later than given.
    stretch : float
        Logarithm of the sensor's millimetres over true ones; zero for an orientation sensor.
    wander : ndarray, shape (k, 3) or (k, 6)
        Wandering error at the knots.
    """

    world: RigidTransform
    mounting: FloatArray
    late_s: float
    stretch: float
    wander: FloatArray

    def moved(self, step: FloatArray) -> SensorState:
        """The state after a step of all its variables, in the order of `SensorEvidence.columns`."""
        c = self.mounting.size
        turn = np.concatenate([step[:c], np.zeros(6 - c)])
        return SensorState(
            self.world * RigidTransform.from_exp_coords(turn),
            self.mounting + step[c : 2 * c],
            self.late_s + float(step[2 * c]),
            self.stretch + float(step[2 * c + 1]),
            self.wander + step[2 * c + 2 :].reshape(self.wander.shape),
        )


@dataclass(frozen=True)
class SensorLimits:
    """How well a sensor's mounting, clock and millimetres are known, standard deviations."""

    mounting_rad: float
    mounting_mm: float
    clock_s: float
    stretch: float


@dataclass(frozen=True)
class SensorEvidence:
    """Readings of one sensor over a sweep.

    Attributes
    ----------
    name : str
        As doubts name it.
    components : int
        3 for rotations, 6 for poses.
    before : ndarray of int, shape (m,)
        Frame before each reading.
    share : ndarray, shape (m,)
        Of the way to the next frame.
    centre_from_sensor : RigidTransform
    measured : RigidTransform, length m
        ``world_from_sensor`` as read.
    velocity : ndarray, shape (m, 6)
        Of the image at each reading by the images, as a twist per second.
    time_s : ndarray, shape (m,)
        On the frames' clock.
    limits : SensorLimits
    jitter : ndarray, shape (2,)
        Standard deviation of a reading's turn, rad, and place, mm, per axis.
    first : int
        Column of its first variable.
    """

    name: str
    components: int
    before: IntArray
    share: FloatArray
    centre_from_sensor: RigidTransform
    measured: RigidTransform
    velocity: FloatArray
    time_s: FloatArray
    limits: SensorLimits
    jitter: FloatArray
    first: int = 0

    @cached_property
    def knots_s(self) -> FloatArray:
        """Times of the wandering error's knots."""
        span = float(np.ptp(self.time_s))
        count = int(np.clip(np.ceil(span / KNOTS_S), 1, MOST_KNOTS - 1)) + 1
        return np.linspace(self.time_s[0], self.time_s[-1], count)

    @property
    def size(self) -> int:
        """Number of its variables."""
        return 2 * self.components + 2 + self.components * self.knots_s.size

    @property
    def wander_columns(self) -> IntArray:
        """Columns of the wandering error, shape (k, components)."""
        c = self.components
        return self.first + 2 * c + 2 + np.arange(c * self.knots_s.size).reshape(-1, c)

    def start(self, poses: RigidTransform) -> SensorState:
        """A state near the best: the world that fits most readings."""
        mounted = self.between(poses) * self.centre_from_sensor
        world = self.measured * mounted.inv()
        turn = world.rotation.mean()
        for _ in range(3):
            apart = (turn.inv() * world.rotation).magnitude()
            turn = world.rotation.mean(weights=1.0 / np.maximum(apart, 1e-3 + np.median(apart)))
        seen = turn.apply(mounted.translation)
        place = np.median(self.measured.translation - seen, axis=0)
        c = self.components
        found = RigidTransform.from_components(place, turn)
        return SensorState(found, np.zeros(c), 0.0, 0.0, np.zeros((self.knots_s.size, c)))

    def between(self, poses: RigidTransform) -> RigidTransform:
        """Poses at the times of the readings, between those of the frames."""
        first = poses[self.before]
        step = (first.inv() * poses[self.before + 1]).as_exp_coords()
        return first * RigidTransform.from_exp_coords(step * self.share[:, None])

    def residuals(self, poses: RigidTransform, state: SensorState) -> tuple[FloatArray, RigidTransform]:
        """Twist from where a reading should be to where it is, shape (m, c), and where it should be."""
        c = self.components
        late = RigidTransform.from_exp_coords(self.velocity * state.late_s)
        expected = state.world * self.between(poses) * late * self._mounted(state)
        error = (expected.inv() * self.measured).as_exp_coords()[:, :c]
        if c == 6:
            place = expected.translation
            out = expected.rotation.inv().apply(place - place.mean(axis=0))
            error[:, 3:] -= state.stretch * out
        return error - self._wandered(expected, state), expected

    def _mounted(self, state: SensorState) -> RigidTransform:
        turn = np.zeros((1, 6))
        turn[0, : self.components] = state.mounting
        return self.centre_from_sensor * RigidTransform.from_exp_coords(turn)

    def _wandered(self, expected: RigidTransform, state: SensorState) -> FloatArray:
        wander = self._between(state.wander)
        if self.components == 6:
            return wander
        return np.asarray(expected.rotation.inv().apply(wander))

    def _between(self, wander: FloatArray) -> FloatArray:
        before, share = self._knot
        return np.asarray(wander[before] * (1 - share)[:, None] + wander[before + 1] * share[:, None])

    @cached_property
    def _knot(self) -> tuple[IntArray, FloatArray]:
        """Knot before each reading, and the share of the way to the next."""
        knots = self.knots_s
        before = np.clip(np.searchsorted(knots, self.time_s, "right") - 1, 0, knots.size - 2)
        return before, (self.time_s - knots[before]) / (knots[1] - knots[0])

    def block(self, poses: RigidTransform, state: SensorState) -> Block:
        """Equations of the readings."""
        c = self.components
        error, expected = self.residuals(poses, state)
        sigma = np.repeat(self.jitter, 3)[:c]
        carried = adjoint(self._mounted(state).inv())[:, :c]
        to_pose = -np.broadcast_to(carried, (len(error), c, 6))
        to_world = -adjoint((state.world.inv() * expected).inv())[:, :c, :c]
        to_clock = to_pose @ self.velocity[:, :, None]
        to_stretch = np.zeros((len(error), c, 1))
        if c == 6:
            place = expected.translation
            to_stretch[:, 3:, 0] = -expected.rotation.inv().apply(place - place.mean(axis=0))
        at_knot = -np.broadcast_to(np.eye(c), (len(error), c, c))
        if c == 3:
            at_knot = -expected.rotation.inv().as_matrix()
        before, share = self._knot
        own = self.first + np.arange(2 * c + 2)
        parts = (
            (pose_columns(self.before), to_pose * (1 - self.share)[:, None, None]),
            (pose_columns(self.before + 1), to_pose * self.share[:, None, None]),
            (
                np.broadcast_to(own, (len(error), own.size)),
                np.concatenate(
                    [to_world, -np.broadcast_to(np.eye(c), to_world.shape), to_clock, to_stretch], axis=2
                ),
            ),
            (self.wander_columns[before], at_knot * (1 - share)[:, None, None]),
            (self.wander_columns[before + 1], at_knot * share[:, None, None]),
        )
        whitened = tuple((columns, slope / sigma[:, None]) for columns, slope in parts)
        return Block(error / sigma, whitened).weighted(outlier_weights(error / sigma))

    def with_least_jitter(self, poses: RigidTransform, state: SensorState) -> SensorEvidence:
        """The evidence with a jitter no less than what is left: readings that repeat hide theirs."""
        error, _ = self.residuals(poses, state)
        left = np.array(
            [robust_sigma(error[:, :3]), robust_sigma(error[:, 3:]) if self.components == 6 else 1.0]
        )
        return replace(self, jitter=np.maximum(self.jitter, left))

    def limits_block(self, state: SensorState) -> Block:
        """Equations of what is known of mounting, clock and millimetres."""
        c, limits = self.components, self.limits
        sigma = np.array(
            [
                *[limits.mounting_rad] * 3,
                *[limits.mounting_mm] * (c - 3),
                limits.clock_s,
                limits.stretch,
            ]
        )
        values = np.array([*state.mounting, state.late_s, state.stretch])
        columns = self.first + c + np.arange(c + 2)
        return Block((values / sigma)[None], ((columns[None], np.diag(1.0 / sigma)[None]),))

    def wander_block(self, state: SensorState, sigma: FloatArray, time_s: float) -> Block:
        """Equations of an error of size `sigma`, shape (components,), that wanders with `time_s`."""
        kept = float(np.exp(-(self.knots_s[1] - self.knots_s[0]) / time_s))
        size = np.tile(sigma * np.sqrt(1.0 - kept**2), (self.knots_s.size, 1))
        size[0] = sigma
        before = np.concatenate([np.zeros((1, self.components)), kept * state.wander[:-1]])
        each = np.apply_along_axis(np.diag, 1, 1.0 / size)
        columns = self.wander_columns
        earlier = np.concatenate([np.full((1, self.components), -1), columns[:-1]])
        return Block((state.wander - before) / size, ((columns, each), (earlier, -kept * each)))


def outlier_weights(whitened: FloatArray) -> FloatArray:
    """One up to `OUTLYING`, beyond it falling so fast that an outlier's pull vanishes.

    Over the median where that is above one: while poses are still far off, no reading is wilder than others.
    """
    size = np.sqrt((whitened**2).mean(axis=1))
    limit = OUTLYING * max(1.0, float(np.median(size)))
    return np.asarray((limit / np.maximum(size, limit)) ** 4)


def read_sensor(
    sensor: OrientationSensor | Tracker,
    name: str,
    start: RigidTransform,
    centre_mm: FloatArray,
    frame_time_s: FloatArray,
    limits: SensorLimits,
) -> SensorEvidence | None:
    """The readings between the frames; None if there are fewer than `FEWEST_READINGS`, or no mounting.

    Parameters
    ----------
    start : RigidTransform, length n
        ``first_from_frame`` about the image's centre, by the images.
    """
    mounting = sensor.sensor_from_image
    time_s = sensor.readings.time_s + sensor.time_offset_s
    inside = (time_s >= frame_time_s[0]) & (time_s <= frame_time_s[-1])
    if mounting is None or inside.sum() < FEWEST_READINGS:
        return None
    time_s = time_s[inside]
    before = np.clip(np.searchsorted(frame_time_s, time_s, "right") - 1, 0, len(start) - 2)
    pause = np.diff(frame_time_s)[before]
    centre = RigidTransform.from_translation(centre_mm)
    samples = sensor.readings.world_from_sensor[np.flatnonzero(inside)]
    if isinstance(mounting, Rotation):
        mounting = RigidTransform.from_rotation(mounting)
    if isinstance(samples, Rotation):
        samples = RigidTransform.from_rotation(samples)
    components = 6 if isinstance(sensor, Tracker) else 3
    centre_from_sensor = centre.inv() * mounting.inv() if components == 6 else mounting.inv()
    evidence = SensorEvidence(
        name,
        components,
        before,
        (time_s - frame_time_s[before]) / pause,
        centre_from_sensor,
        samples,
        (start[before].inv() * start[before + 1]).as_exp_coords() / pause[:, None],
        time_s,
        limits,
        np.ones(2),
    )
    error, _ = evidence.residuals(start, evidence.start(start))
    return replace(evidence, jitter=_jitter(error))


def _jitter(error: FloatArray) -> FloatArray:
    """Standard deviation of turn and place, from second differences, which slow errors are not in."""
    bent = (error[2:] - 2.0 * error[1:-1] + error[:-2]) / np.sqrt(6.0)
    place = robust_sigma(bent[:, 3:], LEAST_JITTER_MM) if error.shape[1] == 6 else 1.0
    return np.array([robust_sigma(bent[:, :3], LEAST_JITTER_RAD), place])
