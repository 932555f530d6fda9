"""A sweep's texture on evenly spaced planes along its smooth path, which polynomials may bend.

Travel along the elevational axis is what images get wrong, so the path is a function of it. Frames are moved
within their own planes, which they know exactly, onto the smooth path; tremor, pauses and uneven speed then
leave no trace, and a place is found by its neighbouring planes alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.ndimage import shift
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import elevational_steps
from speckle3d.correction.crossing.stack import PIXEL_MM
from speckle3d.correction.crossing.sweep import CrossingSweep
from speckle3d.correction.crossing.texture import local_contrast
from speckle3d.correction.curves import ELEVATIONAL, CorrectedChain

BENT = (*ELEVATIONAL, "x")
ORDERS = 3
BENDS = len(BENT) * ORDERS
"""Coefficients of Legendre polynomials along the sweep: of the relative change of elevational steps, then of
tilt, yaw and motion sideways per signed elevational mm of the images, rad/mm and 1. Where sweeps cross
obliquely, structure that moves sideways feigns another length: 2 % of it at 45 degrees for 3 % sideways."""

_SMOOTH_MM = 1.0
"""Travel over which the path is smoothed: a hand's slow wander stays. A third of it and twice as much move
lengths by up to 0.2 %, a quarter of their claims."""
_WIDEST_GAP_MM = 1.5
"""Travel without a frame that is interpolated: about an elevational beam width."""


@dataclass(frozen=True)
class StraightSweep:
    """Texture of a sweep on the planes of its path.

    Attributes
    ----------
    texture : ndarray, shape (k, u, v)
        Local contrast; NaN where no frame shows the place.
    pixels : ndarray, shape (4,)
        Pixel size along u and v, and where the first pixel lies from the image's centre, mm.
    planes, frames : CorrectedChain
        Poses of planes and frames about the image's centre, in the frame of the middle plane, by bends.
    nearest : int
        Frame nearest to the middle plane.
    world : Rotation or None
        Sensor's world from the path's frame.
    """

    texture: Float32Array
    pixels: FloatArray
    planes: CorrectedChain
    frames: CorrectedChain
    nearest: int
    world: Rotation | None

    @property
    def spacing_mm(self) -> FloatArray:
        """Between voxels along the sweep, across and along the beam."""
        return np.array([PIXEL_MM, *self.pixels[:2]])

    @property
    def length_mm(self) -> float:
        """Travel from the first plane to the last."""
        return PIXEL_MM * (len(self.texture) - 1)

    def bent_frames(self, bends: FloatArray) -> RigidTransform:
        """Every frame's pose on the bent path, whose middle stays in place."""
        start, poses = (self.frames.poses(coefficients) for coefficients in (np.zeros(BENDS), bends))
        at = self.nearest
        return RigidTransform.from_matrix(start[at] @ np.linalg.inv(poses[at]) @ poses)

    def mean_rates(self) -> FloatArray:
        """Mean relative change of steps, tilt and yaw per mm by bends, shape (3, 12)."""
        return np.asarray(np.kron(np.eye(3, len(BENT)), self.planes.basis[1:, 0].mean(axis=0) / PIXEL_MM))


def relative_turn(first: StraightSweep, second: StraightSweep) -> Rotation | None:
    """Turn of the second path against the first by both sensors; None unless both have one."""
    if first.world is None or second.world is None:
        return None
    return first.world.inv() * second.world


def straighten(sweep: CrossingSweep, nearest_mm: float = 0.0) -> StraightSweep:
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
    images, good, grid = sweep.stack.images(len(sweep.poses)), sweep.good, sweep.stack.grid
    if good.size < 10:
        raise InsufficientDataError(
            f"{sweep.name}: expected at least 10 frames to be trusted, got {good.size}; sweep again, slower"
        )
    travel = np.concatenate([[0.0], np.cumsum(elevational_steps(sweep.poses, sweep.centre_mm))])
    low, high = float(travel[good].min()), float(travel[good].max())
    if high - low < 10 * PIXEL_MM:
        raise InsufficientDataError(
            f"{sweep.name}: expected a sweep along the elevational axis, got {high - low:.1f} mm of travel; "
            "sweep across the tissue, 24 mm or more"
        )
    count = 1 + int((high - low) / PIXEL_MM)
    travel -= low + count // 2 * PIXEL_MM
    at = np.multiply(np.arange(count) - count // 2, PIXEL_MM, dtype=np.float64)
    about_centre = sweep.poses * RigidTransform.from_translation(sweep.centre_mm)
    frames = _smooth_path(travel[good], about_centre[good], np.zeros(1))[0].inv() * about_centre
    planes, base = (_smooth_path(travel[good], frames[good], place) for place in (at, travel))
    away = base.inv() * frames
    travel = travel + away.translation[:, 2]
    top_mm = grid.first_sample_depth_mm
    pixels = np.array([grid.vector_pitch_mm, grid.sample_spacing_mm, grid.first_vector_mm, top_mm])
    pixels[2:] -= sweep.centre_mm[:2]
    # Within a plane frames roll too little about the smooth path to matter.
    shifts = away.translation[:, :2] / pixels[:2]
    images = np.stack([shift(images[f], shifts[f], order=1, cval=np.nan) for f in good])
    images[:, :, top_mm + np.arange(grid.samples) * grid.sample_spacing_mm < nearest_mm] = np.nan
    texture = local_contrast(
        _onto_planes(images, travel[good], at),
        np.array([PIXEL_MM, grid.vector_pitch_mm, grid.sample_spacing_mm]),
    )
    return StraightSweep(
        texture,
        pixels,
        _chain(planes, at),
        _chain(frames, travel),
        int(np.argmin(np.abs(travel))),
        None if sweep.orientation is None else (sweep.orientation * frames.rotation.inv()).mean(),
    )


def _chain(poses: RigidTransform, travel_mm: FloatArray) -> CorrectedChain:
    """Poses whose steps along the path are bent by polynomials of the travel, which is zero in its middle."""
    along = 0.5 * (travel_mm[1:] + travel_mm[:-1]) / np.abs(travel_mm).max()
    basis = np.zeros((len(poses), len(BENT), ORDERS))
    basis[1:] = (elevational_steps(poses, np.zeros(3))[:, None] * legendre.legvander(along, ORDERS - 1))[
        :, None
    ]
    return CorrectedChain.of(poses, BENT, basis)


def _smooth_path(travel: FloatArray, poses: RigidTransform, at: FloatArray) -> RigidTransform:
    """Poses as a smooth function of travel: local straight lines."""
    mean = poses.rotation.mean()
    values = np.concatenate([poses.translation, (mean.inv() * poses.rotation).as_rotvec()], axis=1)
    away = travel - at[:, None]
    # Far from all frames the nearest still count.
    reach = np.maximum(_SMOOTH_MM, np.abs(away).min(axis=1, keepdims=True))
    weight = np.exp(-0.5 * (away / reach) ** 2)
    total, first, second = ((weight * away**k).sum(axis=1, keepdims=True) for k in (0, 1, 2))
    # A little stiffness, 1e-6 mm2, keeps the slope finite where all frames are in one place.
    weight = weight * (1.0 - first / (second + 1e-6 * total) * away)
    smooth = weight @ values / weight.sum(axis=1, keepdims=True)
    return RigidTransform.from_components(smooth[:, :3], mean * Rotation.from_rotvec(smooth[:, 3:]))


def _onto_planes(images: Float32Array, travel: FloatArray, at: FloatArray) -> Float32Array:
    """Images on planes, between the mean images of the frames about either neighbour: shape (k, u, v)."""
    # A hand that dwells must not draw the images of the planes about it: frames of one place count as one.
    place, many = np.unique(np.round(travel / PIXEL_MM).astype(int), return_inverse=True, return_counts=True)[
        1:
    ]
    mean = (place == np.arange(many.size)[:, None]) / many[:, None]
    middle = mean @ travel
    after = np.clip(np.searchsorted(middle, at), 1, many.size - 1)
    gap = middle[after] - middle[after - 1]
    fraction = np.clip((at - middle[after - 1]) / gap, 0.0, 1.0)[:, None]
    weight = ((1.0 - fraction) * mean[after - 1] + fraction * mean[after]).astype(np.float32)
    flat = images.reshape(len(images), -1)
    valid = np.isfinite(flat)
    coverage = weight @ valid.astype(np.float32)
    dense = (coverage > 0.25) & (gap < 2.0 * _WIDEST_GAP_MM)[:, None]
    total = weight @ np.where(valid, flat, np.float32(0.0))
    volume = np.divide(total, coverage, out=np.full_like(total, np.nan), where=dense)
    return np.asarray(volume.reshape(len(at), *images.shape[1:]), dtype=np.float32)
