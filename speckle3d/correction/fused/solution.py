"""The problem as a whole: its state, its iterations, the sizes of sensors' errors, covariances."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.sparse.linalg import SuperLU
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.correction.fused.images import SLOW, ErrorSize, ImageErrors, ImageEvidence, pose_columns
from speckle3d.correction.fused.problem import Block, Normal, evidence
from speckle3d.correction.fused.sensors import SensorEvidence, SensorState
from speckle3d.correction.fused.sizes import (
    Grid,
    Sizes,
    Wander,
    scale_changes,
    steady,
    turn_changes,
    turns,
    wanders,
)
from speckle3d.correction.scale import ScaleEvidence

ROUNDS = 15
SIZED = 3
"""Rounds before sizes of errors are found."""
SETTLED = 1e-4
"""Step, mm and rad, at which the iteration ends: a hundredth of what poses are known to."""
KNOWN_FRAMES = 40
"""Frames whose covariance is computed; those of the others are interpolated."""
LOOSENED = 3.0
"""Factor of the scale that the images' steps may all have wrong while other errors are sized: a sensor that
is right about a wrong scale does not wander."""


@dataclass(frozen=True)
class State:
    """All variables: poses about the image's centre, errors of the images, sensors."""

    poses: RigidTransform
    errors: ImageErrors
    sensors: tuple[SensorState, ...]

    def moved(self, step: FloatArray, sensors: Sequence[SensorEvidence]) -> State:
        """The state after a step of all variables, in the order of the problem's columns."""
        n, knots = len(self.poses), len(self.errors.changing) - 1
        lengths = [6 * (n - 1), 3, 2 * SLOW, 3 * knots, *(sensor.size for sensor in sensors)]
        motion, common, slow, changing, *own = np.split(step, np.cumsum(lengths)[:-1])
        every = np.concatenate([np.zeros((1, 6)), motion.reshape(-1, 6)])
        change = np.concatenate([np.zeros((1, 3)), changing.reshape(-1, 3)])
        return State(
            self.poses * RigidTransform.from_exp_coords(every),
            ImageErrors(
                self.errors.common + common,
                self.errors.slow + slow.reshape(-1, 2),
                self.errors.changing + change,
            ),
            tuple(sensor.moved(part) for sensor, part in zip(self.sensors, own, strict=True)),
        )


@dataclass(frozen=True)
class Solution:
    """The best state, and the covariance of what is asked for."""

    state: State
    normal: Normal
    sizes: Sizes
    images: ImageEvidence

    @cached_property
    def factor(self) -> SuperLU:
        """Factors of the normal matrix."""
        return self.normal.factor()

    def covariance(self, frames: IntArray) -> FloatArray:
        """Covariance of some frames' poses along the first frame's axes, all with all, (6 f, 6 f)."""
        columns = pose_columns(frames).ravel()
        unit = np.zeros((self.normal.matrix.shape[0], columns.size))
        unit[columns, np.arange(columns.size)] = 1.0
        solved = self.factor.solve(unit)[columns]
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

    @property
    def names(self) -> tuple[str, ...]:
        """What takes part."""
        others = (*(sensor.name for sensor in self.sensors), *(each.source for each in self.evidence))
        return ("images", *others)

    def start(self) -> State:
        """The images' own poses."""
        poses = self.images.start
        errors = ImageErrors(np.zeros(3), np.zeros((SLOW, 2)), np.zeros((self.images.knots.size, 3)))
        return State(poses, errors, tuple(sensor.start(poses) for sensor in self.sensors))

    def expected_sizes(self) -> Sizes:
        """Sizes of errors before they are found."""
        wander = (
            expected or steady(sensor) for sensor, expected in zip(self.sensors, self.expected, strict=True)
        )
        return Sizes(ErrorSize(np.ones(3), np.ones(3)), tuple(wander))

    def solve(self) -> tuple[Solution, Problem]:
        """The best state, with sizes of errors as found; and the problem with jitters as found."""
        problem, state, sizes = self, self.start(), self.expected_sizes()
        if self.sensors:
            state = self.settled(state, sizes, SIZED).state
            problem = self._with_jitter(state)
            sizes = problem._sizes(state)
        return problem.settled(state, sizes), problem

    def settled(self, state: State, sizes: Sizes, rounds: int = ROUNDS) -> Solution:
        """Gauss-Newton to the end, or for some rounds."""
        for _ in range(rounds):
            state, moved = self._stepped(state, sizes)
            if moved < SETTLED:
                break
        return Solution(state, self.normal(state, sizes), sizes, self.images)

    def _stepped(self, state: State, sizes: Sizes) -> tuple[State, float]:
        """The state after one round, and the largest change of a pose, mm or rad."""
        normal = self.normal(state, sizes)
        step = -normal.factor().solve(normal.gradient)
        return state.moved(step, self.sensors), float(np.abs(step[: 6 * (len(self.images) - 1)]).max())

    def normal(self, state: State, sizes: Sizes) -> Normal:
        """Normal equations of all there is."""
        return Normal.of([*self._measured(state), *self._priors(state, sizes)], self.size)

    def _measured(self, state: State) -> list[Block]:
        """Equations that do not depend on sizes."""
        blocks = self.images.blocks(state.poses, state.errors)
        blocks += [self._scale_block(state, each) for each in self.evidence]
        for sensor, own in zip(self.sensors, state.sensors, strict=True):
            blocks += [sensor.block(state.poses, own), sensor.limits_block(own)]
        return blocks

    def _priors(self, state: State, sizes: Sizes) -> list[Block]:
        """Equations whose weights are the errors' sizes."""
        blocks = self.images.prior_blocks(state.errors, sizes.images)
        for sensor, own, wander in zip(self.sensors, state.sensors, sizes.wander, strict=True):
            blocks.append(sensor.wander_block(own, wander.sigma, wander.time_s))
        return blocks

    def _scale_block(self, state: State, evidence: ScaleEvidence) -> Block:
        """Equations of the mean scale and turn over the sweep, as one source has them."""
        frames, weight = self.images.parts
        mean = weight @ self.images.distortion(state.errors)[frames] / self.images.path_mm
        scale = 1.0 + mean[0]
        size, axes = np.linalg.eigh(evidence.information)
        root = np.sqrt(np.maximum(size, 0.0))[:, None] * axes.T
        error = np.array([np.log(scale), *mean[1:] / scale]) - evidence.values
        slope = root @ np.eye(3) / scale / self.images.path_mm
        parts = self.images.distortion_parts(frames[None], weight[None], state.errors, slope[None])
        return Block((root @ error)[None], parts)

    def _with_jitter(self, state: State) -> Problem:
        """The problem with jitters that are no less than what is left of the readings."""
        return replace(
            self,
            sensors=tuple(
                sensor.with_least_jitter(state.poses, own)
                for sensor, own in zip(self.sensors, state.sensors, strict=True)
            ),
        )

    def _sizes(self, state: State) -> Sizes:
        """Sizes of errors, one kind after the other."""
        first = 6 * (len(self.images) - 1)
        matrix, gradient = Normal.of(self._measured(state), self.size).reduced(self.size - first)
        sizes = self.expected_sizes()
        loose = ErrorSize(np.array([LOOSENED, 1.0, 1.0]), np.ones(3))
        sizes = replace(sizes, images=loose)
        kinds: list[Callable[[Sizes], Grid]] = [turns, turn_changes, scale_changes]
        for number, (sensor, expected) in enumerate(zip(self.sensors, self.expected, strict=True)):
            kinds.append(partial(wanders, number=number, sensor=sensor, expected=expected))
        for kind in kinds:
            grid = kind(sizes)
            likelihood = [evidence(matrix, gradient, self._priors(state, each), first) for each in grid.sizes]
            sizes = grid.mean(np.array(likelihood))
        tight = ErrorSize(sizes.images.common / [LOOSENED, 1.0, 1.0], sizes.images.changing)
        return replace(sizes, images=tight)
