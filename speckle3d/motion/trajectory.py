"""Frame pairs to poses: which pairs to measure, and the least-squares trajectory of all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import FloatArray, rotation_from_fixed_angles, skew
from speckle3d.motion.inplane import InPlaneMotion
from speckle3d.motion.planes import PairPlane

class TrajectorySettings(BaseModel):
    """Which frame pairs are measured and how they are joined."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recent: int = Field(2, ge=1, description="Frames just before each frame that it is measured against.")
    key_frames: int = Field(4, ge=1, description="Key frames before each frame that it is measured against.")
    far_key_frames: int = Field(
        4, ge=0, description="Older key frames that every other frame is measured against, to see what stays."
    )
    key_correlation: float = Field(
        0.9,
        gt=0,
        lt=1,
        description="A frame becomes a key frame when its median correlation with the last is less.",
    )
    least_correlation: float = Field(
        0.2,
        gt=0,
        lt=1,
        description="Least median correlation that a pair must have, and that speckle at its distance would, "
        "to be used.",
    )
    huber: float = Field(2.0, gt=0, description="Standard deviations at which a pair begins to lose weight.")
    join: Literal["graph", "chain"] = Field(
        "graph",
        description="graph: least squares over all pairs. chain: each frame by the one earlier frame that "
        "tells its distance best, for comparison.",
    )


@dataclass(frozen=True)
class PairMeasurement:
    """One frame pair: in-plane motion and unsigned plane."""

    first: int
    second: int
    motion: InPlaneMotion
    plane: PairPlane


@dataclass(frozen=True)
class SignedPair:
    """A frame pair with its relative pose about the image's centre."""

    first: int
    second: int
    pose: RigidTransform
    covariance: FloatArray
    """Of (x, y, z, tilt, yaw, roll), shape (6, 6), mm and rad."""


class PairSchedule:
    """Keeps the frames that the next one is measured against: a few recent ones and a few key frames."""

    def __init__(self, settings: TrajectorySettings | None = None) -> None:
        self.settings = settings or TrajectorySettings()
        self._keys: list[int] = []

    def references(self, frame: int) -> list[int]:
        """Earlier frames to measure `frame` against, latest first."""
        recent = range(max(0, frame - self.settings.recent), frame)
        keys = self._keys if frame % 2 else self._keys[-self.settings.key_frames :]
        return sorted({*recent, *keys}, reverse=True)

    def settle(self, frame: int, correlations: dict[int, float]) -> None:
        """Take note of the median correlations of `frame` with its references."""
        last = self._keys[-1] if self._keys else None
        if last is None or correlations.get(last, 0.0) < self.settings.key_correlation:
            self._keys = [*self._keys, frame][-(self.settings.key_frames + self.settings.far_key_frames) :]

    def needed(self, frame: int) -> set[int]:
        """Frames up to `frame` that later ones may be measured against."""
        return {*range(max(0, frame - self.settings.recent + 1), frame + 1), *self._keys}


def sign_pair(pair: PairMeasurement, sign: float) -> SignedPair:
    """Relative pose of a pair, about the image's centre, from in-plane motion and signed plane."""
    plane = pair.plane
    a, b, c = sign * plane.coefficients
    yaw = -np.arcsin(np.clip(b, -1, 1))
    tilt = np.arcsin(np.clip(c / np.cos(yaw), -1, 1))
    m = pair.motion
    rotation = rotation_from_fixed_angles(m.roll_rad, yaw, tilt)
    pose = RigidTransform.from_components([m.x_mm, m.y_mm, a], rotation)
    covariance = np.zeros((6, 6))
    inplane = m.covariance if m.covariance is not None else np.eye(3)
    covariance[np.ix_([0, 1, 5], [0, 1, 5])] = inplane + np.diag([1e-6, 1e-6, 1e-9])
    # (a, b, c) is (z, -yaw, tilt) for small angles.
    order = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    covariance[np.ix_([2, 3, 4], [2, 3, 4])] = order @ plane.covariance @ order.T
    return SignedPair(pair.first, pair.second, pose, covariance)


def solve_trajectory(
    pairs: Sequence[SignedPair],
    frames: int,
    centre_mm: FloatArray,
    settings: TrajectorySettings | None = None,
    rounds: int = 6,
) -> RigidTransform:
    """Poses of all frames from all pairs: robust Gauss-Newton on the graph of relative poses.

    Returns
    -------
    RigidTransform, length `frames`
        ``world_from_image`` with the first frame at the identity.

    Raises
    ------
    InsufficientDataError
        If a frame is joined to no earlier one.
    """
    s = settings or TrajectorySettings()
    first = np.array([p.first for p in pairs])
    second = np.array([p.second for p in pairs])
    _require_connected(second, frames)
    measured = RigidTransform.concatenate([p.pose for p in pairs])
    whitening = np.linalg.cholesky(np.linalg.inv(np.array([p.covariance for p in pairs]))).transpose(0, 2, 1)
    poses = _chain(pairs, frames, s.join == "chain")
    for _ in range(rounds if s.join == "graph" else 0):
        step = _gauss_newton_step(poses, first, second, measured, whitening, s.huber)
        poses = poses * RigidTransform.from_exp_coords(step)
        if np.abs(step).max() < 1e-7:
            break
    centre = RigidTransform.from_translation(centre_mm)
    return centre * poses * centre.inv()


def _require_connected(second: FloatArray, frames: int) -> None:
    joined = np.zeros(frames, dtype=bool)
    joined[0] = True
    joined[second.astype(int)] = True
    if not joined.all():
        lost = int(np.flatnonzero(~joined)[0])
        raise InsufficientDataError(
            f"frame {lost}: expected speckle in common with an earlier frame, found none "
            f"({int((~joined).sum())} of {frames} frames so)"
        )


def _chain(pairs: Sequence[SignedPair], frames: int, relative: bool) -> RigidTransform:
    """Each frame from the pair whose distance is most certain, absolutely or relative to its size."""

    def doubt(p: SignedPair) -> float:
        variance = float(p.covariance[2, 2])
        return variance / max(float(p.pose.translation[2]) ** 2, 1e-6) if relative else variance

    best: dict[int, SignedPair] = {}
    for p in pairs:
        kept = best.get(p.second)
        if kept is None or doubt(p) < doubt(kept):
            best[p.second] = p
    matrices = np.tile(np.eye(4), (frames, 1, 1))
    for frame in range(1, frames):
        matrices[frame] = matrices[best[frame].first] @ best[frame].pose.as_matrix()
    return RigidTransform.from_matrix(matrices)


def _gauss_newton_step(
    poses: RigidTransform,
    first: FloatArray,
    second: FloatArray,
    measured: RigidTransform,
    whitening: FloatArray,
    huber: float,
) -> FloatArray:
    """One step on right increments of every pose but the first; shape (n, 6), rotation then translation."""
    relative = poses[first].inv() * poses[second]
    error = (measured.inv() * relative).as_exp_coords()
    # The covariance's order is translation, rotation; exponential coordinates' is rotation, translation.
    swap = [3, 4, 5, 0, 1, 2]
    w = whitening[:, :, swap]
    r = np.einsum("eij,ej->ei", w, error)
    size = np.linalg.norm(r, axis=1) / np.sqrt(6)
    w = w * np.sqrt(np.minimum(1.0, huber / np.maximum(size, 1e-9)))[:, None, None]
    r = np.einsum("eij,ej->ei", w, error)
    j_second = w
    j_first = -w @ _adjoint(relative.inv())
    edges, n = first.size, len(poses)
    rows = (6 * np.arange(edges)[:, None, None] + np.arange(6)[:, None]) + np.zeros((1, 1, 6), dtype=int)
    column = np.arange(6)[None, None, :] + np.zeros((1, 6, 1), dtype=int)
    jacobian = sparse.csr_matrix(
        (
            np.concatenate([j_first.ravel(), j_second.ravel()]),
            (
                np.concatenate([rows.ravel(), rows.ravel()]),
                np.concatenate(
                    [
                        (6 * first[:, None, None] + column).ravel(),
                        (6 * second[:, None, None] + column).ravel(),
                    ]
                ),
            ),
        ),
        shape=(6 * edges, 6 * n),
    )[:, 6:]
    normal = (jacobian.T @ jacobian + 1e-9 * sparse.identity(6 * (n - 1))).tocsc()
    step = splu(normal).solve(-(jacobian.T @ r.ravel()))
    return np.concatenate([np.zeros((1, 6)), step.reshape(-1, 6)])


def _adjoint(pose: RigidTransform) -> FloatArray:
    """Adjoint matrices for (rotation, translation) twists, shape (e, 6, 6)."""
    matrix = pose.as_matrix()
    r, t = matrix[:, :3, :3], matrix[:, :3, 3]
    cross = skew(t)
    adjoint = np.zeros((len(r), 6, 6))
    adjoint[:, :3, :3] = adjoint[:, 3:, 3:] = r
    adjoint[:, 3:, :3] = cross @ r
    return adjoint
