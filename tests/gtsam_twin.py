"""The fused problem in GTSAM: the same variables and errors, with its poses, factors and marginals."""

from __future__ import annotations

import numpy as np
import pytest

from speckle3d.core.arrays import FloatArray
from speckle3d.correction.fused.images import ImageErrors
from speckle3d.correction.fused.sensors import SensorState
from speckle3d.correction.fused.solution import Problem, State

gtsam = pytest.importorskip("gtsam")

STEP = 1e-6


def pose(matrix: FloatArray) -> gtsam.Pose3:
    return gtsam.Pose3(matrix)


def x(frame: int) -> int:
    return gtsam.symbol("x", frame)


ERRORS, WORLD, SENSOR = gtsam.symbol("e", 0), gtsam.symbol("w", 0), gtsam.symbol("s", 0)


def numeric(function, values, sizes):
    """Derivatives of a function of poses and vectors by central differences, one matrix each."""
    out = []
    for k, size in enumerate(sizes):
        columns = []
        for c in range(size):
            moved = []
            for sign in (1.0, -1.0):
                step = np.zeros(size)
                step[c] = sign * STEP
                other = values[k].retract(step) if isinstance(values[k], gtsam.Pose3) else values[k] + step
                moved.append(function(*values[:k], other, *values[k + 1 :]))
            columns.append((moved[0] - moved[1]) / (2 * STEP))
        out.append(np.array(columns).T)
    return out


def factor(noise, keys, kinds, function):
    """A custom factor of a function of poses ("pose") and vectors (their length)."""

    def error(this, values, jacobians):
        own = [
            values.atPose3(key) if kind == "pose" else values.atVector(key)
            for key, kind in zip(this.keys(), kinds, strict=True)
        ]
        if jacobians is not None:
            sizes = [6 if kind == "pose" else kind for kind in kinds]
            for k, each in enumerate(numeric(function, own, sizes)):
                jacobians[k] = np.asfortranarray(each)
        return function(*own)

    return gtsam.CustomFactor(noise, keys, error)


class Twin:
    """A `Problem` with at most one tracker, at given sizes of errors, as a factor graph."""

    def __init__(self, problem: Problem, state: State, sizes) -> None:
        self.problem, self.images = problem, problem.images
        self.graph, self.start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.knots = self.images.knots.size - 1
        self.length = 3 + state.errors.slow.size + 3 * self.knots
        for frame, matrix in enumerate(state.poses.as_matrix()):
            self.start.insert(x(frame), pose(matrix))
        self.start.insert(ERRORS, np.zeros(self.length))
        self.graph.add(gtsam.NonlinearEqualityPose3(x(0), pose(np.eye(4))))
        self._edges()
        self._chain()
        self._rows(
            self.images.prior_blocks(state.errors, sizes.images), ERRORS, 6 * (len(self.images) - 1), state
        )
        if problem.sensors:
            self._tracker(state, sizes)

    def _errors(self, vector: FloatArray) -> ImageErrors:
        slow = self.length - 3 - 3 * self.knots
        changing = np.vstack([np.zeros(3), vector[3 + slow :].reshape(-1, 3)])
        return ImageErrors(vector[:3], vector[3 : 3 + slow].reshape(-1, 2), changing)

    def _edges(self) -> None:
        edges = self.images.edges
        grown = edges.covariance * np.outer(self.images.growth, self.images.growth)
        order = [3, 4, 5, 0, 1, 2]
        for k in range(len(edges)):
            measured = pose(edges.poses[k].as_matrix())
            i, j = int(edges.first[k]), int(edges.second[k])

            def error(first, second, vector, i=i, j=j, measured=measured):
                distortion = self.images.distortion(self._errors(vector))
                twist = gtsam.Pose3.Logmap(measured.between(first.between(second)))
                twist[[5, 0, 1]] -= distortion[j] - distortion[i]
                return twist

            noise = gtsam.noiseModel.Gaussian.Covariance(grown[k][np.ix_(order, order)])
            self.graph.add(factor(noise, [x(i), x(j), ERRORS], ["pose", "pose", self.length], error))

    def _chain(self) -> None:
        noise = gtsam.noiseModel.Diagonal.Sigmas([0.05] * 3 + [1.0] * 3)
        start = self.images.start
        for k in range(len(start) - 1):
            step = pose((start[k].inv() * start[k + 1]).as_matrix())
            self.graph.add(gtsam.BetweenFactorPose3(x(k), x(k + 1), step, noise))

    def _rows(self, blocks, key, first, state) -> None:
        """Linear equations, which are prior knowledge of vectors."""
        size = self.problem.size
        length = self.length if key == ERRORS else self.sensor_length
        for block in blocks:
            matrix = block.jacobian(size).toarray()[:, first : first + length]
            constant = block.residual.ravel()
            noise = gtsam.noiseModel.Unit.Create(constant.size)
            at = np.zeros(length)
            self.graph.add(
                factor(noise, [key], [length], lambda v, m=matrix, c=constant, a=at: c + m @ (v - a))
            )

    def _tracker(self, state: State, sizes) -> None:
        sensor, own = self.problem.sensors[0], state.sensors[0]
        c = 6
        self.sensor_length = sensor.size - c
        self.start.insert(WORLD, pose(own.world.as_matrix()))
        self.start.insert(SENSOR, np.zeros(self.sensor_length))
        still = SensorState(own.world, np.zeros(c), 0.0, 0.0, np.zeros_like(own.wander))
        wander = sizes.wander[0]
        blocks = [sensor.limits_block(still), sensor.wander_block(still, wander.sigma, wander.time_s)]
        self._rows(blocks, SENSOR, sensor.first + c, state)
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(sensor.jitter, 3))
        mounted = pose(sensor.centre_from_sensor.as_matrix())
        middle = (own.world * sensor.between(state.poses) * sensor.centre_from_sensor).translation.mean(
            axis=0
        )
        knots = sensor.knots_s
        for k in range(len(sensor.time_s)):
            share, seen = float(sensor.share[k]), pose(sensor.measured[k].as_matrix())
            speed, time = sensor.velocity[k], float(sensor.time_s[k])

            def error(first, second, world, vector, share=share, seen=seen, speed=speed, time=time):
                step = gtsam.Pose3.Logmap(first.between(second))
                here = first.compose(gtsam.Pose3.Expmap(share * step)).compose(
                    gtsam.Pose3.Expmap(speed * vector[6])
                )
                expected = world.compose(here).compose(mounted).compose(gtsam.Pose3.Expmap(vector[:6]))
                twist = gtsam.Pose3.Logmap(expected.between(seen))
                out = expected.rotation().unrotate(expected.translation() - middle)
                twist[3:] -= vector[7] * out
                drift = vector[8:].reshape(-1, 6)
                return twist - [np.interp(time, knots, column) for column in drift.T]

            frame = int(sensor.before[k])
            keys = [x(frame), x(frame + 1), WORLD, SENSOR]
            kinds = ["pose", "pose", "pose", self.sensor_length]
            self.graph.add(factor(noise, keys, kinds, error))

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """Poses, shape (n, 4, 4), and the covariance of the last one's twist, shape (6, 6)."""
        found = gtsam.LevenbergMarquardtOptimizer(self.graph, self.start).optimize()
        n = len(self.images)
        poses = np.array([found.atPose3(x(k)).matrix() for k in range(n)])
        return poses, gtsam.Marginals(self.graph, found).marginalCovariance(x(n - 1))
