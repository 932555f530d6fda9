"""A sweep as evenly spaced planes along a smooth path that scale and turns may bend.

Travel along the elevational axis is what images get wrong, so the path is a function of it. Frames are moved
within their own planes, which they know exactly, onto the smooth path; tremor, pauses and uneven speed then
leave no trace, and a place is found by its neighbouring planes alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.polynomial import legendre
from scipy.ndimage import affine_transform
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import rotation_from_fixed_angles
from speckle3d.correction.crossing.sweep import CrossingSweep
from speckle3d.correction.curves import cumulative_product

BENDS = ("scale0", "scale1", "scale2", "tilt0", "tilt1", "yaw0", "yaw1")
"""Coefficients of Legendre polynomials along the sweep: of the logarithm of the scale, and of tilt and yaw
per signed elevational mm, rad/mm. The path's middle stays in place."""

SPACING_MM = 0.35
"""Between planes: as the pixels."""

_SMOOTH_MM = 1.0
"""Travel over which the path is smoothed: a hand's slow wander stays."""
_WIDEST_GAP_MM = 1.5
"""Travel without a frame that is interpolated: about an elevational beam width."""
_EACH_MM = 0.2
"""Least standard deviation of the weight of frames about a plane."""


@dataclass(frozen=True)
class Path:
    """Planes along a sweep, in the frame of the middle one, about the image's centre.

    Attributes
    ----------
    travel_mm : ndarray, shape (k,)
        Signed elevational position of each plane, increasing, from the middle.
    planes : ndarray, shape (k, 4, 4)
        Path from plane, before bending.
    """

    travel_mm: FloatArray
    planes: FloatArray

    @property
    def length_mm(self) -> float:
        """Travel from the first plane to the last."""
        return float(self.travel_mm[-1] - self.travel_mm[0])

    @cached_property
    def _basis(self) -> FloatArray:
        """Legendre polynomials of order 0 to 2 midway between planes, shape (k - 1, 3)."""
        along = 0.5 * (self.travel_mm[1:] + self.travel_mm[:-1])
        return np.asarray(legendre.legvander(along / (0.5 * self.length_mm), 2), dtype=float)

    @cached_property
    def _steps(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.planes[:-1]) @ self.planes[1:])

    def log_scale(self, bends: FloatArray) -> FloatArray:
        """Logarithm of true over given elevational distance between planes, shape (k - 1,)."""
        return np.asarray(self._basis @ bends[:3])

    def mean_scale(self) -> FloatArray:
        """Weight of each bend in the mean logarithm of the scale, shape (7,)."""
        return np.concatenate([self._basis.mean(axis=0), np.zeros(4)])

    def bent(self, bends: FloatArray) -> FloatArray:
        """Path from plane with scale and turns applied, shape (k, 4, 4)."""
        steps = np.empty((len(self.planes), 4, 4))
        steps[0] = np.eye(4)
        steps[1:] = self._steps
        along = steps[1:, 2, 3] * np.exp(self.log_scale(bends))
        steps[1:, 2, 3] = along
        tilt, yaw = (along * (self._basis[:, :2] @ bends[k : k + 2]) for k in (3, 5))
        turn = rotation_from_fixed_angles(np.zeros(len(along)), yaw, tilt).as_matrix()
        steps[1:, :3, :3] = steps[1:, :3, :3] @ turn
        chain = cumulative_product(steps)
        middle = len(chain) // 2
        return np.asarray(self.planes[middle] @ np.linalg.inv(chain[middle]) @ chain)

    def twists(self, bends: FloatArray, bent: FloatArray) -> FloatArray:
        """How each plane moves with each bend, shape (k, 6, 7): shift at the path's origin, turn.

        Parameters
        ----------
        bent : ndarray, shape (k, 4, 4)
            As returned by `bent` for the same bends.
        """
        along = self._steps[:, 2, 3] * np.exp(self.log_scale(bends))
        before, after = bent[:-1], bent[1:]
        # Each step moves all later planes rigidly: along z of the plane before it, about x and y after it.
        moves = np.zeros((len(along), 6, 3))
        moves[:, :3, 0] = before[:, :3, 2]
        for axis in (0, 1):
            turn = after[:, :3, axis]
            moves[:, 3:, 1 + axis] = turn
            moves[:, :3, 1 + axis] = np.cross(after[:, :3, 3], turn)
        moves *= along[:, None, None]
        tilt, yaw = (self._basis[:, :2] @ bends[k : k + 2] for k in (3, 5))
        # More travel is more turn, too.
        moves[:, :, 0] += tilt[:, None] * moves[:, :, 1] + yaw[:, None] * moves[:, :, 2]
        each = np.concatenate(
            [
                moves[:, :, :1] * self._basis[:, None, :],
                moves[:, :, 1:2] * self._basis[:, None, :2],
                moves[:, :, 2:3] * self._basis[:, None, :2],
            ],
            axis=2,
        )
        found = np.zeros((len(bent), 6, len(BENDS)))
        np.cumsum(each, axis=0, out=found[1:])
        return np.asarray(found - found[len(bent) // 2])


@dataclass(frozen=True)
class StraightSweep:
    """Images of a sweep on the planes of its path.

    Attributes
    ----------
    path : Path
    volume : ndarray, shape (k, u, v)
        dB; NaN where no frame shows the place.
    pixels : ndarray, shape (4,)
        Pixel size along u and v, and where the first pixel lies from the image's centre, mm.
    frames : RigidTransform, length n
        Every frame's pose in the path's frame, about the image's centre.
    frame_travel_mm : ndarray, shape (n,)
        As `Path.travel_mm`.
    """

    path: Path
    volume: Float32Array
    pixels: FloatArray
    frames: RigidTransform
    frame_travel_mm: FloatArray

    @property
    def spacing_mm(self) -> FloatArray:
        """Between voxels along the sweep, across and along the beam."""
        return np.array([self.path.length_mm / (len(self.volume) - 1), *self.pixels[:2]])

    def mirrored(self) -> StraightSweep:
        """The same sweep having gone the other way."""
        flip = np.diag([1.0, 1.0, -1.0, 1.0])
        return replace(
            self,
            path=Path(-self.path.travel_mm[::-1], flip @ self.path.planes[::-1] @ flip),
            volume=np.ascontiguousarray(self.volume[::-1]),
            frames=RigidTransform.from_matrix(flip @ self.frames.as_matrix() @ flip),
            frame_travel_mm=-self.frame_travel_mm,
        )

    def corrected(self, bends: FloatArray) -> RigidTransform:
        """Every frame's pose on the bent path, about the image's centre, in the path's frame."""
        before = _between(self.path.planes, self.path.travel_mm, self.frame_travel_mm)
        after = _between(self.path.bent(bends), self.path.travel_mm, self.frame_travel_mm)
        return after * before.inv() * self.frames


def straightened(sweep: CrossingSweep, nearest_mm: float = 0.0) -> StraightSweep:
    """Put a sweep's frames on the planes of its smooth path.

    Parameters
    ----------
    sweep : CrossingSweep
    nearest_mm : float
        Depth above which nothing is looked at.

    Raises
    ------
    InsufficientDataError
        If it has too few frames, or did not move.
    """
    images = sweep.stack.images(len(sweep.poses))
    good, grid = sweep.good, sweep.stack.grid
    if good.size < 10:
        raise InsufficientDataError(
            f"{sweep.name}: expected at least 10 frames to be trusted, got {good.size}; sweep again, slower"
        )
    centred = sweep.poses * RigidTransform.from_translation(sweep.centre_mm)
    steps = (centred[:-1].inv() * centred[1:]).translation[:, 2]
    travel = np.concatenate([[0.0], np.cumsum(steps)])
    low, high = float(travel[good].min()), float(travel[good].max())
    if high - low < 10 * SPACING_MM:
        raise InsufficientDataError(
            f"{sweep.name}: expected a sweep along the elevational axis, got {high - low:.1f} mm of travel; "
            "sweep across the tissue, 24 mm or more"
        )
    at = np.asarray(low + np.arange(1 + int((high - low) / SPACING_MM)) * SPACING_MM, dtype=np.float64)
    middle = len(at) // 2
    smooth = partial(_smoothed, travel[good], centred[good])
    to_path = smooth(at[middle : middle + 1])[0].inv()
    planes, base = to_path * smooth(at), to_path * smooth(travel)
    frames = to_path * centred
    away = base.inv() * frames
    travel = travel + away.translation[:, 2]
    pixels = np.array(
        [
            grid.vector_pitch_mm,
            grid.sample_spacing_mm,
            sweep.stack.left_mm - sweep.centre_mm[0],
            grid.first_sample_depth_mm - sweep.centre_mm[1],
        ]
    )
    moved = np.stack([_moved(images[f], away[f], pixels) for f in good])
    volume = _onto_planes(moved, travel[good], at)
    skipped = max(0, math.ceil((nearest_mm - grid.first_sample_depth_mm) / grid.sample_spacing_mm))
    volume = np.ascontiguousarray(volume[:, :, min(skipped, volume.shape[2] - 2) :])
    pixels[3] += min(skipped, grid.samples - 2) * grid.sample_spacing_mm
    path = Path(at - at[middle], planes.as_matrix())
    return StraightSweep(path, volume, pixels, frames, travel - at[middle])


def _smoothed(travel: FloatArray, poses: RigidTransform, at: FloatArray) -> RigidTransform:
    """Poses as a smooth function of travel: local straight lines."""
    mean = poses.rotation.mean()
    values = np.concatenate([poses.translation, (mean.inv() * poses.rotation).as_rotvec()], axis=1)
    away = travel[None, :] - at[:, None]
    # Far from all frames the nearest still count.
    reach = np.maximum(_SMOOTH_MM, np.abs(away).min(axis=1, keepdims=True))
    weight = _on_lines(np.exp(-0.5 * (away / reach) ** 2), away, 1e-6)
    found = weight @ values / weight.sum(axis=1, keepdims=True)
    return RigidTransform.from_components(found[:, :3], mean * Rotation.from_rotvec(found[:, 3:]))


def _on_lines(weight: FloatArray, away: FloatArray, stiffness: float | FloatArray) -> FloatArray:
    """Weights whose sums are the values at zero of straight lines fitted with the weights given, (k, n).

    A little stiffness, mm2, keeps the slope finite where all frames are in one place.
    """
    total, first, second = ((weight * away**k).sum(axis=1, keepdims=True) for k in (0, 1, 2))
    return np.asarray(weight * (1.0 - first / (second + stiffness * total) * away))


def _moved(image: Float32Array, plane_from_frame: RigidTransform, pixels: FloatArray) -> Float32Array:
    """The image of a frame on its plane: moved within it and turned about the image's centre."""
    size, first = pixels[:2], pixels[2:]
    roll = float(plane_from_frame.rotation.as_rotvec()[2])
    back = np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    matrix = back * size[None, :] / size[:, None]
    offset = (back @ (first - plane_from_frame.translation[:2]) - first) / size
    return np.asarray(affine_transform(image, matrix, offset, order=1, mode="constant", cval=np.nan))


def _onto_planes(images: Float32Array, travel: FloatArray, at: FloatArray) -> Float32Array:
    off = travel[None, :] - at[:, None]
    away = np.abs(off)
    order = np.sort(away, axis=1)
    reach = np.maximum(_EACH_MM, 0.5 * order[:, min(1, order.shape[1] - 1)])
    # Frames crowd where the hand dwells: each counts for the travel it stands for, or it would draw the
    # images of the planes about it.
    crowd = np.exp(-0.5 * ((travel[None, :] - travel[:, None]) / _EACH_MM) ** 2).sum(axis=1)
    weight = np.exp(-0.5 * (away / reach[:, None]) ** 2) / crowd
    weight[weight < 0.02 * weight.max(axis=1, keepdims=True)] = 0.0
    # What a plane shows is centred on it.
    weight = _on_lines(weight, off, 0.01 * reach[:, None] ** 2).astype(np.float32)
    there = np.isfinite(images).reshape(len(images), -1)
    flat = np.where(there, images.reshape(len(images), -1), np.float32(0.0))
    share = weight @ there.astype(np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        volume = np.where(share > 0.25 * weight.sum(axis=1)[:, None], weight @ flat / share, np.nan)
    volume[order[:, 0] > _WIDEST_GAP_MM] = np.nan
    return np.asarray(volume.reshape(len(at), *images.shape[1:]), dtype=np.float32)


def _between(planes: FloatArray, travel_mm: FloatArray, at: FloatArray) -> RigidTransform:
    """Poses at places along the path, straight on beyond its ends."""
    k = np.clip(np.searchsorted(travel_mm, at) - 1, 0, len(travel_mm) - 2)
    share = (at - travel_mm[k]) / (travel_mm[k + 1] - travel_mm[k])
    here, there = (RigidTransform.from_matrix(planes[i]) for i in (k, k + 1))
    turn = (here.rotation.inv() * there.rotation).as_rotvec() * share[:, None]
    moved = here.translation + share[:, None] * (there.translation - here.translation)
    return RigidTransform.from_components(moved, here.rotation * Rotation.from_rotvec(turn))
