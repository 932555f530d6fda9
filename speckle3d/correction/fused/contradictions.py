"""Which source contradicts the images: poses with it against poses without, beyond the errors of both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.doubts import Doubt
from speckle3d.correction.fused.images import ErrorSize
from speckle3d.correction.fused.sizes import Sizes
from speckle3d.correction.fused.solution import Problem, Solution, State

PARTS = ("x", "y", "z", "tilt", "yaw", "roll")
COMPARED = 3
"""Rounds for the poses that are compared, which start near."""
MOST_CHANGE = 2.0
"""Factor by which the images' scale may change more than claimed before a source contradicts it."""
LEAST_SHARE = 0.05
"""Share of the images' variance that a difference is expected to have at least: a source that tells next to
nothing shifts poses by next to nothing, and rounding must not count as evidence."""


@dataclass(frozen=True)
class Contradiction:
    """A source that differs from the images by more than the errors of both.

    Attributes
    ----------
    parts : ndarray of int
        In which of `PARTS`.
    """

    doubt: Doubt
    parts: IntArray


def contradictions(problem: Problem, solution: Solution, sigmas: float) -> list[Contradiction]:
    """Compare what the images say of the farthest and the last frame with what they say with each source.

    Parameters
    ----------
    sigmas : float
        Deviations beyond which a source contradicts the images.
    """
    sources: list[tuple[int | None, int | None]] = [(k, None) for k in range(len(problem.sensors))]
    sources += [(None, k) for k in range(len(problem.evidence))]
    if not sources:
        return []
    alone = _restricted(problem, solution, None, None)
    found = []
    for name, (sensor, evidence) in zip(problem.names[1:], sources, strict=True):
        both = solution if len(sources) == 1 else _restricted(problem, solution, sensor, evidence)
        each = _compared(alone, both, name, sigmas)
        found += [each] if each else []
    return found


def _restricted(problem: Problem, solution: Solution, sensor: int | None, evidence: int | None) -> Solution:
    """The solution by the images and one source, with errors sized as they were with all."""
    some = [] if sensor is None else [sensor]
    less = Problem.of(
        problem.images,
        [(problem.sensors[k], problem.expected[k]) for k in some],
        [] if evidence is None else [problem.evidence[evidence]],
    )
    found = solution.sizes.images
    # A scale that changes more than the images claim is not to hide that they differ from the source.
    changing = np.minimum(found.changing, [MOST_CHANGE, np.inf, np.inf])
    images = found if some or evidence is not None else ErrorSize(found.common, changing)
    sizes = Sizes(images, tuple(solution.sizes.wander[k] for k in some))
    sensors = tuple(solution.state.sensors[k] for k in some)
    state = replace(solution.state, sensors=sensors) if some else less.start()
    return less.settled(State(state.poses, state.errors, state.sensors), sizes, COMPARED)


def _compared(alone: Solution, both: Solution, name: str, sigmas: float) -> Contradiction | None:
    frames, _ = alone.images.parts
    before, after = alone.covariance(frames), both.covariance(frames)
    shift = difference(alone.state.poses[frames], both.state.poses[frames])
    variance = np.diag(before).reshape(-1, 6), np.diag(after).reshape(-1, 6)
    expected = np.sqrt(np.maximum(variance[0] - variance[1], LEAST_SHARE * variance[0]))
    size = np.abs(shift) / expected
    if size.max() <= sigmas:
        return None
    row, part = np.unravel_index(int(np.argmax(size)), size.shape)
    unit, factor = ("mm", 1.0) if part < 3 else ("degrees", float(np.degrees(1.0)))
    own, apart = factor * np.sqrt(variance[0][row, part]), factor * abs(shift[row, part])
    evidence = (
        f"expected frame {frames[row]} in {PARTS[part]} where images have it to {own:.2g} {unit}, "
        f"got it {apart:.2g} {unit} from there, {size[row, part]:.0f} times what the errors of both allow"
    )
    suspect = "its mounting or wander, or curves of another probe"
    contrary = np.flatnonzero((size > sigmas).any(axis=0)).astype(np.int64)
    return Contradiction(Doubt(name, suspect, evidence, False), contrary)


def difference(first: RigidTransform, second: RigidTransform) -> FloatArray:
    """(x, y, z, tilt, yaw, roll) from the first poses to the second, along the world's axes, shape (m, 6)."""
    turn = (second.rotation * first.rotation.inv()).as_rotvec()
    return np.hstack([second.translation - first.translation, turn])
