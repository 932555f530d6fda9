"""The problem as a whole: its state, its iterations, the sizes of sensors' errors, covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.correction.fused.images import ImageEvidence, pose_columns
from speckle3d.correction.fused.problem import Block, Normal, evidence
from speckle3d.correction.fused.sensors import SensorEvidence, SensorState
from speckle3d.correction.scale import ScaleEvidence

ROUNDS = 15
SETTLED = 1e-6
"""Step, mm and rad, at which the iteration ends."""
KNOWN_FRAMES = 40
"""Frames whose covariance is computed; those of the others are interpolated."""
WANDER = (0.05, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Sizes tried of a tracker's wandering error over its jitter; the first stands for none."""
WANDER_TIMES_S = (1.0, 5.0, 20.0)
STEADY = 0.5
"""Probability, before anything is measured, that a tracker does not wander."""
FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Sizes tried of an orientation sensor's wandering error over the expected."""
FACTOR_SPREAD = 0.7
"""Standard deviation of the logarithm of that factor among sensors: twice, or half."""


@dataclass(frozen=True)
class Wander:
    """Size, shape (components,), and time of a sensor's wandering error."""

    sigma: FloatArray
    time_s: float


@dataclass(frozen=True)
class State:
    """All variables: poses about the image's centre, errors of the images, sensors."""

    poses: RigidTransform
    distortion: FloatArray
    common: FloatArray
    sensors: tuple[SensorState, ...]

    def moved(self, step: FloatArray, sizes: Sequence[int]) -> State:
        """The state after a step of all variables, in the order of the problem's columns."""
        n = len(self.poses)
        motion = np.concatenate([np.zeros((1, 6)), step[: 6 * (n - 1)].reshape(-1, 6)])
        change = np.concatenate([np.zeros((1, 3)), step[6 * (n - 1) : 9 * (n - 1)].reshape(-1, 3)])
        own = np.split(step[9 * (n - 1) + 3 :], np.cumsum(sizes)[:-1]) if sizes else []
        return State(
            self.poses * RigidTransform.from_exp_coords(motion),
            self.distortion + change,
            self.common + step[9 * (n - 1) : 9 * (n - 1) + 3],
            tuple(sensor.moved(part) for sensor, part in zip(self.sensors, own, strict=True)),
        )


@dataclass(frozen=True)
class Solution:
    """The best state, and the covariance of what is asked for."""

    state: State
    normal: Normal
    wander: tuple[Wander, ...]
    images: ImageEvidence

    def covariance(self, frames: IntArray) -> FloatArray:
        """Covariance of some frames' poses along the first frame's axes, all with all, (6 f, 6 f)."""
        factor = self.normal.factor()
        columns = pose_columns(frames).ravel()
        unit = np.zeros((self.normal.matrix.shape[0], columns.size))
        unit[columns, np.arange(columns.size)] = 1.0
        solved = factor.solve(unit)[columns]
        turn = np.zeros((columns.size, columns.size))
        for k, rotation in enumerate(self.state.poses[frames].rotation.as_matrix()):
            # Translation before rotation, and along the first frame's axes.
            turn[6 * k : 6 * k + 3, 6 * k + 3 : 6 * k + 6] = rotation
            turn[6 * k + 3 : 6 * k + 6, 6 * k : 6 * k + 3] = rotation
        covariance = turn @ solved @ turn.T
        return np.asarray((covariance + covariance.T) / 2)

    def marginals(self) -> FloatArray:
        """Covariance of every frame's (x, y, z, tilt, yaw, roll) against the first, shape (n, 6, 6)."""
        n = len(self.images)
        known = np.unique(np.linspace(1, n - 1, min(n - 1, KNOWN_FRAMES)).round().astype(int))
        joint = self.covariance(known).reshape(known.size, 6, known.size, 6)
        blocks = np.concatenate(
            [np.zeros((1, 36)), joint[np.arange(known.size), :, np.arange(known.size)].reshape(-1, 36)]
        )
        at = np.concatenate([[0], known])
        every = [np.interp(np.arange(n), at, column) for column in blocks.T]
        return np.stack(every, axis=1).reshape(n, 6, 6)


@dataclass(frozen=True)
class Problem:
    """Images, sensors and evidence of the scale of one sweep."""

    images: ImageEvidence
    sensors: tuple[SensorEvidence, ...]
    expected: tuple[Wander | None, ...]
    evidence: tuple[ScaleEvidence, ...]

    @classmethod
    def of(
        cls,
        images: ImageEvidence,
        sensors: Sequence[tuple[SensorEvidence, Wander | None]],
        evidence: Sequence[ScaleEvidence],
    ) -> Problem:
        """The problem with columns given to the sensors' variables.

        Parameters
        ----------
        sensors : sequence of (SensorEvidence, Wander or None)
            With what a sensor is expected to wander by; None if only its readings tell.
        """
        placed, column = [], images.size
        for sensor, _ in sensors:
            placed.append(replace(sensor, first=column))
            column += sensor.size
        return cls(images, tuple(placed), tuple(expected for _, expected in sensors), tuple(evidence))

    @property
    def size(self) -> int:
        """Number of variables."""
        return self.images.size + sum(sensor.size for sensor in self.sensors)

    def start(self) -> State:
        """The images' own poses."""
        poses = self.images.start
        still = np.zeros((len(poses), 3))
        return State(poses, still, np.zeros(3), tuple(sensor.start(poses) for sensor in self.sensors))

    def solve(self, start: State | None = None) -> tuple[Solution, Problem]:
        """Gauss-Newton, and between its rounds the sizes of the sensors' errors."""
        state = start or self.start()
        problem, wander = self, self._steady()
        for number in range(ROUNDS):
            normal = problem.normal(state, wander)
            step = -normal.factor().solve(normal.gradient)
            state = state.moved(step, [sensor.size for sensor in self.sensors])
            if number in (1, 3) and self.sensors:
                problem = problem._with_jitter(state)
                wander = problem._sizes(state, wander)
            elif np.abs(step[: 9 * (len(self.images) - 1)]).max() < SETTLED and number > 3:
                break
        return Solution(state, problem.normal(state, wander), wander, self.images), problem

    def normal(self, state: State, wander: Sequence[Wander], without: int | None = None) -> Normal:
        """Normal equations; `without` the wander of one sensor, by number."""
        blocks = self.images.blocks(state.poses, state.distortion, state.common)
        blocks += [self._scale_block(state, each) for each in self.evidence]
        for number, (sensor, own) in enumerate(zip(self.sensors, state.sensors, strict=True)):
            blocks += [sensor.block(state.poses, own), sensor.limits_block(own)]
            if number != without:
                blocks.append(sensor.wander_block(own, wander[number].sigma, wander[number].time_s))
        return Normal.of(blocks, self.size)

    def _scale_block(self, state: State, evidence: ScaleEvidence) -> Block:
        """Equations of the mean scale and turn over the sweep, as one source has them."""
        frames, weight = self.images.parts
        mean = weight @ state.distortion[frames] / self.images.path_mm
        scale = 1.0 + mean[0]
        size, axes = np.linalg.eigh(evidence.information)
        root = np.sqrt(np.maximum(size, 0.0))[:, None] * axes.T
        error = np.array([np.log(scale), *mean[1:] / scale]) - evidence.values
        slope = root @ np.eye(3) / scale / self.images.path_mm
        columns = self.images.error_columns(frames)
        parts = tuple((columns[[k]], slope[None] * weight[k]) for k in range(frames.size))
        return Block((root @ error)[None], parts)

    def _steady(self) -> tuple[Wander, ...]:
        """What the sensors are expected to wander by."""
        return tuple(
            expected or Wander(WANDER[0] * np.repeat(sensor.jitter, 3), WANDER_TIMES_S[-1])
            for sensor, expected in zip(self.sensors, self.expected, strict=True)
        )

    def _with_jitter(self, state: State) -> Problem:
        """The problem with jitters that are no less than what is left of the readings."""
        return replace(
            self,
            sensors=tuple(
                sensor.with_least_jitter(state.poses, own)
                for sensor, own in zip(self.sensors, state.sensors, strict=True)
            ),
        )

    def _sizes(self, state: State, wander: Sequence[Wander]) -> tuple[Wander, ...]:
        """Wandering errors' sizes: means over a grid by restricted likelihood."""
        found = list(wander)
        for number, expected in enumerate(self.expected):
            sensor, own = self.sensors[number], state.sensors[number]
            still = replace(own, wander=np.zeros_like(own.wander))
            others = [*state.sensors[:number], still, *state.sensors[number + 1 :]]
            normal = self.normal(replace(state, sensors=tuple(others)), found, without=number)
            first = self.images.size
            matrix, gradient = normal.reduced(self.size - first)
            grid, prior = _candidates(sensor, expected)
            likelihood = np.empty(len(grid))
            for k, candidate in enumerate(grid):
                block = sensor.wander_block(still, candidate.sigma, candidate.time_s)
                jacobian = block.jacobian(self.size)[:, first:].toarray()
                likelihood[k] = evidence(matrix, gradient, jacobian.T @ jacobian)
            weight = prior * np.exp(likelihood - likelihood.max())
            weight /= weight.sum()
            variance = weight @ np.array([candidate.sigma**2 for candidate in grid])
            time_s = float(np.exp(weight @ np.log([candidate.time_s for candidate in grid])))
            found[number] = Wander(np.sqrt(variance), time_s)
        return tuple(found)


def _candidates(sensor: SensorEvidence, expected: Wander | None) -> tuple[list[Wander], FloatArray]:
    """Sizes and times tried of a sensor's wandering error, and their probabilities beforehand."""
    if expected is None:
        jitter = np.repeat(sensor.jitter, 3)
        sizes = [(size, time) for size in WANDER for time in WANDER_TIMES_S]
        prior = np.array(
            [STEADY if size == WANDER[0] else (1 - STEADY) / (len(WANDER) - 1) for size, _ in sizes]
        )
        return [Wander(size * jitter, time) for size, time in sizes], prior
    both = [(a, b) for a in FACTORS for b in FACTORS]
    prior = np.exp(-0.5 * (np.log(np.array(both)) ** 2).sum(axis=1) / FACTOR_SPREAD**2)
    return [Wander(expected.sigma * [a, a, b], expected.time_s) for a, b in both], prior
