"""From a pixel to a phantom: the chain of transforms that every calibration with a phantom solves for.

A pixel (u, v) is carried through ``target_from_world * world_from_sensor * sensor_from_image`` to the
phantom's frame C, where the phantom says which components must vanish (Prager et al. 1997, equations 3, 7
and 8). The fourteen parameters keep that report's names; those that a phantom leaves undetermined are held.

References
----------
.. [1] Prager et al., "Automatic calibration for 3-D free-hand ultrasound", CUED/F-INFENG/TR 303, 1997.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from calibration.wander import WanderingFit
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.geometry import require_finite, roll_yaw_tilt, rotation_from_fixed_angles
from speckle3d.core.leastsquares import Fit
from speckle3d.core.shown import shown
from speckle3d.kernels.chain import chain_derivatives

SeenAs = Literal["line", "direction", "dot"]

SCALES = ("s_x", "s_y")
POSE = ("x", "y", "z", "alpha", "beta", "gamma")
"""``sensor_from_image`` (the report's R_T_P): position, mm, and fixed angles, rad."""
ANGLES = POSE[3:]
PROBE = (*SCALES, *POSE)
"""Pixel size, mm, and ``sensor_from_image``."""
TARGET = ("x_c", "y_c", "z_c", "alpha_c", "beta_c", "gamma_c")
"""``target_from_world`` (the report's C_T_T)."""
CHAIN = (*PROBE, *TARGET)


@shown
@dataclass(frozen=True)
class ImagePoints:
    """Points of a phantom in the images, and where the sensor was.

    Parameters
    ----------
    pixels : ndarray, shape (n, 2)
        Column u and row v, fractional.
    frame : ndarray of int, shape (n,)
        The frame each point is in; points of a frame are used or dropped together.
    world_from_sensor : RigidTransform, length n
        Translation in mm.
    wire : ndarray of int, shape (n,), optional
        The wire each point lies on.
    time_s : ndarray, shape (n,), optional
        When each point's frame was taken; without it, frames are taken to be evenly spaced. A sensor's error
        wanders with it.
    """

    pixels: FloatArray
    frame: IntArray
    world_from_sensor: RigidTransform
    wire: IntArray | None = None
    time_s: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.pixels.ndim != 2 or self.pixels.shape[1] != 2:
            raise InvalidInputError(f"pixels: expected shape (n, 2), got {self.pixels.shape}")
        require_finite(self.pixels, "pixels")
        counts = {len(self.pixels), len(self.frame), len(self.world_from_sensor)}
        counts |= {len(one) for one in (self.wire, self.time_s) if one is not None}
        if len(counts) > 1:
            raise MismatchError(
                f"expected as many points as frames, poses, wires and times, got {sorted(counts)}"
            )

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, chosen: BoolArray | IntArray | slice) -> ImagePoints:
        wire = None if self.wire is None else self.wire[chosen]
        time_s = None if self.time_s is None else self.time_s[chosen]
        return ImagePoints(
            self.pixels[chosen], self.frame[chosen], self.world_from_sensor[chosen], wire, time_s
        )

    @cached_property
    def turns(self) -> FloatArray:
        """Rotation matrices of the poses, shape (n, 3, 3)."""
        return np.ascontiguousarray(self.world_from_sensor.as_matrix()[:, :3, :3])

    @cached_property
    def shifts_mm(self) -> FloatArray:
        """Translations of the poses, shape (n, 3)."""
        return np.asarray(self.world_from_sensor.translation)

    @cached_property
    def frames(self) -> IntArray:
        """Numbers of the frames that have points, ascending."""
        return np.unique(self.frame)

    def of_some_frames(self, count: int) -> ImagePoints:
        """The points of at most `count` frames, spread evenly over the recording."""
        places = np.unique(np.linspace(0, len(self.frames) - 1, count).astype(int))
        return self[np.isin(self.frame, self.frames[places])]

    @property
    def times(self) -> FloatArray:
        """`time_s`, or the frames' numbers where times are not known, shape (n,)."""
        return np.asarray(self.frame, dtype=float) if self.time_s is None else self.time_s

    @classmethod
    def of_lines(
        cls,
        frame: IntArray,
        points_px: FloatArray,
        world_from_sensor: RigidTransform,
        time_s: FloatArray | None = None,
    ) -> ImagePoints:
        """Two points of a line in each frame: m frames, poses and times, `points_px` of shape (m, 2, 2)."""
        twice = np.repeat(np.arange(len(frame)), 2)
        times = None if time_s is None else np.asarray(time_s)[twice]
        poses = world_from_sensor[twice]
        return cls(points_px.reshape(-1, 2), np.asarray(frame)[twice], poses, time_s=times)


@dataclass(frozen=True)
class Seen:
    """What was found in the images of a sequence.

    Attributes
    ----------
    frame : ndarray of int, shape (m,)
        Of each line, or of each dot; ascending.
    pixels : ndarray, shape (m, 2, 2) for lines, (m, 2) for dots
        Column and row, fractional, of two points on each line, or of each dot.
    wire : ndarray of int, shape (m,), optional
        Number of the wire that each dot shows.
    dropped : dict of int to str
        Why other frames show nothing.
    """

    frame: IntArray
    pixels: FloatArray
    wire: IntArray | None = None
    dropped: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, chosen: BoolArray | IntArray) -> Seen:
        wire = None if self.wire is None else self.wire[chosen]
        return Seen(self.frame[chosen], self.pixels[chosen], wire, self.dropped)

    def without(self, frames: Collection[int], reason: str) -> Seen:
        """Leave out frames, for the same reason each, whether anything was found in them or not."""
        if not frames:
            return self
        kept = self[~np.isin(self.frame, list(frames))]
        return replace(kept, dropped={**self.dropped, **dict.fromkeys(frames, reason)})

    @property
    def are_lines(self) -> bool:
        """Whether lines were found, not dots."""
        return self.pixels.ndim == 3

    def points(self, world_from_sensor: RigidTransform, time_s: FloatArray | None = None) -> ImagePoints:
        """Join with the sensor's pose and the time of each line or dot."""
        if self.are_lines:
            return ImagePoints.of_lines(self.frame, self.pixels, world_from_sensor, time_s)
        return ImagePoints(self.pixels, self.frame, world_from_sensor, self.wire, time_s)


def as_directions(lines: ImagePoints) -> ImagePoints:
    """Directions of lines given by two points each; their poses keep the rotation alone."""
    turns = RigidTransform.from_rotation(lines.world_from_sensor[::2].rotation)
    return replace(lines[::2], pixels=lines.pixels[1::2] - lines.pixels[::2], world_from_sensor=turns)


class Phantom(Protocol):
    """What must vanish in the phantom's frame."""

    @property
    def seen_as(self) -> SeenAs:
        """What the points are: the two ends of a line, the direction of one, or a dot."""

    @property
    def kept_in_plane(self) -> bool:
        """Whether a hand must keep it in the image, and misses it by an error that wanders."""

    @property
    def determined(self) -> tuple[str, ...]:
        """Those of `TARGET` that images of the phantom determine."""

    def vanishing(self, points: ImagePoints) -> tuple[FloatArray, FloatArray]:
        """Rows, shape (n, r, 3), and offsets, (n, r): ``rows @ position - offsets`` is the residual, mm."""


@dataclass(frozen=True)
class Chain:
    """An estimate of the whole chain.

    Attributes
    ----------
    pixel_mm : ndarray, shape (2,)
        Column pitch and row spacing.
    """

    pixel_mm: FloatArray
    sensor_from_image: RigidTransform
    target_from_world: RigidTransform

    def target_from_image(self, points: ImagePoints) -> RigidTransform:
        """Pose of the image of each point in the phantom's frame."""
        probe, target = self.sensor_from_image.as_matrix(), self.target_from_world.as_matrix()
        # Products of transforms are checked, pose by pose, which takes ten times as long.
        return RigidTransform(target @ points.world_from_sensor.as_matrix() @ probe, normalize=False)

    def parameters(self) -> FloatArray:
        """The fourteen parameters in the order of `CHAIN`, angles in the canonical form."""
        probe, target = self.sensor_from_image, self.target_from_world
        angles = [roll_yaw_tilt(t.rotation) for t in (probe, target)]
        return np.concatenate([self.pixel_mm, probe.translation, angles[0], target.translation, angles[1]])

    @classmethod
    def from_parameters(cls, parameters: FloatArray) -> Chain:
        """Inverse of `parameters`; negative pixel sizes are brought into the canonical form."""
        angles, pixel_mm = canonical(parameters[5:8], parameters[:2])
        return cls(
            pixel_mm,
            RigidTransform.from_components(parameters[2:5], rotation_from_fixed_angles(*angles)),
            RigidTransform.from_components(parameters[8:11], rotation_from_fixed_angles(*parameters[11:14])),
        )


@dataclass(frozen=True)
class PixelPrior:
    """What is known of the pixel size before anything is measured.

    Parameters
    ----------
    pixel_mm : ndarray, shape (2,)
        Column pitch and row spacing, as the scanner's calipers have them.
    error : float
        Their standard error, as a share of them.
    """

    pixel_mm: FloatArray
    error: float

    def deviation(self, pixel_mm: FloatArray) -> FloatArray:
        """Deviation of other sizes, in standard errors, shape (2,)."""
        return np.asarray((pixel_mm / self.pixel_mm - 1.0) / self.error)


@dataclass(frozen=True)
class Rival:
    """Another answer, far away, to which a discrete ambiguity of the phantom leads.

    Attributes
    ----------
    chain : Chain
    evidence : float
        By how much the sum of its squared residuals exceeds that of the solution, in variances of a residual
        that is independent of the others.
    """

    chain: Chain
    evidence: float


@shown
@dataclass(frozen=True)
class ChainSolution:
    """A calibration as the solver leaves it: the chain, its certainty, and the frames it is made from.

    Attributes
    ----------
    chain : Chain
    free : tuple of str, length p
        The parameters estimated, among `CHAIN`.
    fit : Fit
        Of the points used, in frames that lie on the image and on the phantom: there the angles are
        small rotations about the image's z, y and x, wherever the sensor is mounted.
    noise : WanderingFit
        What the sensor's errors are like, and the covariance that follows.
    points : ImagePoints
        All that were given.
    used : ndarray of bool, shape (n,)
    residuals : ndarray, shape (n, r)
        Of all points, mm (sines of angles for directions).
    sigma : float
        Robust standard deviation of the residuals of the points used.
    published_condition_number : float
        Of the scaled Jacobian in the sensor's and the world's own frames, as published (TR 303, Table 2);
        large where a mounting is near a singularity of its angles, however sufficient the motion.
    prior : PixelPrior, optional
        That the solution takes into account.
    rival : Rival, optional
        The other answer that explains the points best.
    """

    chain: Chain
    phantom: Phantom
    free: tuple[str, ...]
    fit: Fit
    noise: WanderingFit
    points: ImagePoints
    used: BoolArray
    residuals: FloatArray
    sigma: float
    published_condition_number: float
    prior: PixelPrior | None = None
    rival: Rival | None = None

    @property
    def condition_number(self) -> float:
        """Of the scaled Jacobian in frames on the image and the phantom: by this motions are judged."""
        return self.fit.condition_number

    @property
    def angular(self) -> bool:
        """Whether only directions are known: residuals are sines of angles, and nothing has a length."""
        return self.phantom.seen_as == "direction"

    @property
    def covariance(self) -> FloatArray:
        """Of the free parameters, shape (p, p), in frames that lie on the image and on the phantom.

        Residuals are correlated within a frame, for a sensor's error moves all its points, and from frame to
        frame, for it wanders.
        """
        return self.noise.covariance

    @property
    def free_columns(self) -> list[int]:
        """Where the free parameters are in `CHAIN`."""
        return [CHAIN.index(name) for name in self.free]

    @cached_property
    def points_used(self) -> ImagePoints:
        """The points that the solution is made from."""
        return self.points[self.used]

    @property
    def rms(self) -> float:
        """Root mean square residual of the points used."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2)))

    def image_covariance(self, names: tuple[str, ...]) -> FloatArray:
        """Covariance of some of the parameters, zero for those held."""
        index = [self.free.index(name) if name in self.free else -1 for name in names]
        known = np.array([i >= 0 for i in index])
        picked = self.covariance[np.ix_(index, index)]
        return np.where(np.outer(known, known), picked, 0.0)


def residuals_and_jacobian(
    parameters: FloatArray, points: ImagePoints, phantom: Phantom
) -> tuple[FloatArray, FloatArray]:
    """Carry pixels to the phantom's frame and see what does not vanish there.

    Parameters
    ----------
    parameters : ndarray, shape (14,)
        In the order of `CHAIN`.

    Returns
    -------
    residuals : ndarray, shape (n, r)
        In mm.
    jacobian : ndarray, shape (n, r, 14)
        Their derivatives with respect to the parameters.
    """
    rows, offsets = phantom.vanishing(points)
    values, jacobian = np.empty(offsets.shape), np.empty((*offsets.shape, len(CHAIN)))
    chain_derivatives(
        np.ascontiguousarray(parameters, dtype=float),
        np.ascontiguousarray(points.pixels, dtype=float),
        np.ascontiguousarray(points.turns),
        np.ascontiguousarray(points.shifts_mm),
        np.ascontiguousarray(rows),
        np.ascontiguousarray(offsets),
        np.arange(len(CHAIN)),
        np.ones(offsets.shape),
        values.reshape(-1),
        jacobian.reshape(-1, len(CHAIN)),
    )
    return values, jacobian


def free_jacobian(points: ImagePoints, phantom: Phantom, chain: Chain, free: Sequence[str]) -> FloatArray:
    """Derivatives by the free parameters in the sensor's and the world's own frames, shape (n r, p)."""
    _, jacobian = residuals_and_jacobian(chain.parameters(), points, phantom)
    return jacobian.reshape(-1, len(CHAIN))[:, [CHAIN.index(name) for name in free]]


def wrapped(angles_rad: npt.ArrayLike) -> FloatArray:
    """Angles brought into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - np.asarray(angles_rad, dtype=float), 2 * np.pi))


def canonical(angles_rad: npt.ArrayLike, pixel_mm: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Bring fixed angles and pixel sizes into the form with positive sizes and |beta| <= pi / 2.

    Several sets of angles and sizes are one calibration: the matrix ``rotation @ diag(s_x, s_y, 0)`` stays
    what it is.

    Parameters
    ----------
    angles_rad : array_like, shape (3,)
        alpha, beta, gamma.
    pixel_mm : array_like, shape (2,)
        s_x, s_y.

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, appendix C. Its second step adds pi to beta, which is
       another rotation; beta is reflected here, which is the same one.
    """
    alpha, beta, gamma = (float(a) for a in wrapped(angles_rad))
    s_x, s_y = (float(s) for s in np.asarray(pixel_mm, dtype=float))
    if abs(beta) > np.pi / 2:
        alpha, beta, gamma = alpha + np.pi, np.copysign(np.pi, beta) - beta, gamma + np.pi
    if s_y < 0:
        gamma, s_y = gamma + np.pi, -s_y
    if s_x < 0:
        alpha, beta, gamma, s_x = alpha + np.pi, -beta, np.pi - gamma, -s_x
    return np.array([*wrapped([alpha, beta, gamma])]), np.array([s_x, s_y])
