"""The plane through a frame pair's patches: the second frame seen from the first.

z(x, y) = a + b (x - xc) + c (y - yc) for points of the second frame, about the image's centre, where
b = R31 and c = R32 of the relative rotation. The plane is fitted to the correlations themselves, whose errors
are nearly Gaussian, and not to distances, which are skewed where speckle has all but gone and missing
where it has. Correlations know no sign; planes as fitted have a >= 0, and the path settles their signs.

Tilt is nearly invisible to decorrelation: a focused beam's wavefront is curved about the focus, so that
turning moves the speckle of all depths alike, and patches see a + c (y - yc - pivot) with a pivot that grows
with depth as y does. The fit keeps what is seen; `speckle3d.motion.uncertainty` weighs it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves, TiltResponse
from speckle3d.core.errors import DECISIVE
from speckle3d.core.threads import in_parallel
from speckle3d.kernels.plane_misfit import EchoModels, FitRules, Levers
from speckle3d.kernels.planes import FittedPlanes, fit_planes
from speckle3d.kernels.statistics import INTERPOLATION, PatchCurves, correlation_variance
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.schedule import TrajectorySettings
from speckle3d.matching.table import CorrelationTable

LEAST_CORRELATION = 0.03
"""A patch that correlates less than this holds no distance at all."""
LEVEL_END = 0.1
"""Correlation at which curves end: below it a patch of some hundred cells cannot tell distances apart. An end
above it is where a curve was no longer measured."""
OUTLYING = 9.0
"""Squared deviations at which the misfit of a patch, or of a pair on a path, is capped: it may be wrong.
Where frames cross, correlation is known to a few thousandths; one patch that lost it would outvote all."""
HAND_SLOPE = 0.015
"""Standard deviation of slopes between frames that share speckle, 0.9 degrees: three times what tracked hands
turn over a millimetre. With 0.05 a few patches take distance for turns: sweeps of six fold by rounding.
Frames are tried as crossing in the image, as those of a probe rocked in place, up to three of them."""
SENSED_SLOPE = 5e-4
"""Standard deviation of slopes between near frames from a smoothed orientation sensor: 0.03 degrees. A
fiftieth moves lengths by less than 0.01 of their claims, thirty times as much by 0.28 of them, and tilt by
0.35 degrees."""


class PlaneSettings(BaseModel):
    """Settings of the fit of planes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bias_mm: float = Field(
        0.02,
        ge=0,
        description="Error common to a pair's distances that no number of patches averages out; it keeps "
        "tiny separations from outweighing long ones.",
    )
    huber: float = Field(2.0, gt=0, description="Standard deviations at which a patch begins to lose weight.")
    support_sigma: float = Field(
        1.0, gt=0, description="Threshold of the orientation-consistent subset, standard deviations."
    )
    turn_deg_per_mm: float = Field(
        0.05,
        gt=0,
        description="Yaw and tilt per distance that sweeps are expected to have, standard deviation; what "
        "images see of them is believed as far as it is more certain than this.",
    )


@dataclass(frozen=True)
class MotionProblem:
    """Curves, patches and settings by which one sweep's correlations are interpreted.

    Attributes
    ----------
    curves : DecorrelationCurves
    patches : PatchGrid
    centre_mm : ndarray, shape (3,)
        The image's centre.
    frames : int
        Of the sweep.
    planes : PlaneSettings
    trajectory : TrajectorySettings
    repeats : array_like of int
        Frames with the image of the one before, in no pair.
    """

    curves: DecorrelationCurves
    patches: PatchGrid
    centre_mm: FloatArray
    frames: int
    planes: PlaneSettings
    trajectory: TrajectorySettings
    repeats: npt.ArrayLike = ()

    @cached_property
    def at_patches(self) -> PatchCurves:
        """Fully developed curves at the patches."""
        at = self.curves.at(self.patches.depth_mm)
        amplitude = np.ascontiguousarray(np.sqrt(at.correlation))
        of_echo = self.curves.key.correlation_of == "echo"
        return PatchCurves(amplitude, float(self.curves.distance_mm[1]), at.cells, of_echo)

    @cached_property
    def levers(self) -> Levers:
        """Lever arms of the slopes at each patch."""
        depth, angle = self.patches.depth_mm, self.patches.angle_rad
        sine, cosine = np.sin(angle), np.cos(angle)
        (x, y) = (self.patches.centre_mm - self.centre_mm[:2]).T
        tilt = self.curves.at(depth).tilt
        if tilt is None:
            # Unknown, it is taken to turn about the focus, and the focus to be as deep as the image's centre.
            tilt = TiltResponse(depth - (depth - y)[cosine.argmax()], 0.0 * depth)
        # A vector of a fan turns about a point on itself, and by the part of the turn that is across it.
        return Levers(x - sine * tilt.pivot_mm, y - cosine * tilt.pivot_mm, cosine * tilt.spread_mm)

    @property
    def width_mm(self) -> float:
        """Standard deviation of the lever arms of the slope along x."""
        return max(float(np.std(self.levers.lateral_mm)), 1e-6)

    @cached_property
    def end_amplitude(self) -> FloatArray:
        """Amplitude at each patch's last distance, beyond which nothing is read; 0 if it has levelled out."""
        end = self.at_patches.amplitude[:, -1]
        return np.where(end**2 > LEVEL_END, end, 0.0)

    @cached_property
    def _typical(self) -> FloatArray:
        """Amplitude of the median patch's fully developed speckle on the curves' grid."""
        return np.asarray(np.median(self.at_patches.amplitude, axis=0))

    def typical_distance(self, amplitude: FloatArray | float) -> FloatArray:
        """Distance at which the median patch's fully developed speckle keeps an amplitude, mm."""
        return np.asarray(np.interp(-amplitude, -self._typical, self.curves.distance_mm))

    def typical_correlation(self, distance_mm: FloatArray) -> FloatArray:
        """Correlation of the median patch's fully developed speckle; 0 where it was not measured."""
        rho = self._typical**2
        beyond = 0.0 if rho[-1] > LEVEL_END else rho[-1]
        return np.interp(distance_mm, self.curves.distance_mm, rho, right=beyond)


@dataclass(frozen=True)
class PairPlanes:
    """Frame pairs, and the plane of each one's second frame seen from the first.

    Attributes
    ----------
    row : ndarray of int, shape (e,)
        Of each pair in its `CorrelationTable`.
    first, second : ndarray of int, shape (e,)
        Its frames.
    coefficients : ndarray, shape (e, 3)
        a, b and c.
    covariance : ndarray, shape (e, 3, 3)
        Of (a, b, c).
    used : ndarray of bool, shape (e, p)
        Patches that took part.
    feigned_yaw : ndarray, shape (e,)
        Standard deviation of b by the bias of distances, where frames are near: it is several times that of
        `covariance` and decides on which side of each other near frames lie. A trajectory does not take it:
        near pairs would then no longer hold neighbouring frames' tilt together.
    """

    row: IntArray
    first: IntArray
    second: IntArray
    coefficients: FloatArray
    covariance: FloatArray
    used: BoolArray
    feigned_yaw: FloatArray

    def __len__(self) -> int:
        return int(self.row.size)

    def __getitem__(self, pairs: IntArray | BoolArray) -> PairPlanes:
        """Subset of the pairs."""
        return PairPlanes(*(getattr(self, field.name)[pairs] for field in fields(self)))

    @property
    def offset_mm(self) -> FloatArray:
        """Offset a of each pair, shape (e,)."""
        return self.coefficients[:, 0]

    @property
    def sign_covariance(self) -> FloatArray:
        """Covariance of (a, b) for the estimate of signs, shape (e, 2, 2)."""
        covariance = self.covariance[:, :2, :2].copy()
        covariance[:, 1, 1] += self.feigned_yaw**2
        return covariance

    def scaled(self, factor: float) -> PairPlanes:
        """Return the same planes with all distances multiplied by a factor."""
        return replace(self, coefficients=self.coefficients * factor, covariance=self.covariance * factor**2)


def fully_developed(patches: int) -> EchoModels:
    """Model of a phantom's speckle, for all pairs."""
    return EchoModels(np.zeros((1, patches)), np.ones((1, patches)))


def pair_planes(
    problem: MotionProblem,
    table: CorrelationTable,
    rows: IntArray,
    models: EchoModels,
    subset: BoolArray | bool = True,
    slopes: FloatArray | None = None,
    either_side: BoolArray | bool = True,
) -> tuple[PairPlanes, BoolArray]:
    """Fit planes to the correlations of frame pairs by robust maximum likelihood, pair by pair.

    Parameters
    ----------
    rows : ndarray of int, shape (e,)
        Of the table.
    models : EchoModels
        How echoes depart from fully developed speckle, by pair or for all.
    subset : ndarray of bool, shape (e, p), optional
        Patches allowed to take part.
    slopes : ndarray, shape (e, 2), optional
        b and c as a sensor has them. The planes' signs are then theirs, and a may be negative.
    either_side : ndarray of bool, shape (e,), optional
        Whether a plane of known slopes may have a < 0; all may, if not given.

    Returns
    -------
    PairPlanes
    ndarray of bool, shape (e,)
        Pairs whose patches determine a plane: not if three or fewer can take part, or if the image's centre
        comes to lie farther away than the curves were measured, or might.
    """
    correlation = table.correlation[rows]
    end = problem.end_amplitude
    least = models.gain * (models.share + (1 - models.share) * end) ** 2
    members = np.isfinite(correlation) & ((end == 0.0) | (correlation > least)) & subset
    members &= (members.sum(axis=1) > 3)[:, None]
    start = problem.typical_distance(np.sqrt(np.maximum(table.median[rows], 0.0)))
    from_sensor = slopes is not None
    start_slopes = np.zeros((rows.size, 2)) if slopes is None else np.ascontiguousarray(slopes)
    side = np.full(rows.size, either_side)
    settings = problem.planes
    slope_sd = SENSED_SLOPE if from_sensor else HAND_SLOPE
    rules = FitRules(from_sensor, slope_sd, 3.0 * HAND_SLOPE, settings.huber, OUTLYING, 2.0 * DECISIVE)
    fits = FittedPlanes(
        np.full((rows.size, 3), np.nan), np.tile(np.eye(3), (rows.size, 1, 1)), np.zeros(rows.size)
    )

    def work(first: int, stop: int) -> None:
        block = slice(first, stop)
        fit_planes(
            correlation[block],
            members[block],
            table.inplane[rows[block], :2],
            EchoModels(*(values[block] if len(values) > 1 else values for values in models)),
            problem.levers,
            problem.at_patches,
            start[block],
            start_slopes[block],
            side[block],
            rules,
            FittedPlanes(*(array[block] for array in fits)),
        )

    in_parallel(work, rows.size)
    coefficients, information, cost = fits
    scatter = np.maximum(1.0, cost / np.maximum(members.sum(axis=1) - 3, 1))
    covariance = np.linalg.inv(information) * scatter[:, None, None]
    covariance[:, 0, 0] += settings.bias_mm**2
    # Uneven over the image by as much as it is, the bias feigns yaw. What is added to a square of distance
    # fades as that grows.
    uneven_mm = settings.bias_mm**2 / (2.0 * np.maximum(np.abs(coefficients[:, 0]), settings.bias_mm))
    # Where next to nothing of the echo is left, any distance fits as well: tens of metres have been seen.
    reach = float(problem.curves.distance_mm[-1])
    determined = (np.abs(coefficients[:, 0]) <= reach) & (covariance[:, 0, 0] <= reach**2)
    if not from_sensor:
        coefficients *= np.where(coefficients[:, :1] < 0, -1.0, 1.0)
    frames = table.first[rows], table.second[rows]
    feigned_yaw = uneven_mm / problem.width_mm
    return PairPlanes(rows, *frames, coefficients, covariance, members, feigned_yaw), determined


def raised(problem: MotionProblem, shift_mm: FloatArray, slopes: FloatArray) -> FloatArray:
    """Elevation of patches above the image's centre on planes of some slopes, shape (e, p).

    Parameters
    ----------
    shift_mm : ndarray, shape (e, 2)
        In-plane displacement of the second frame.
    slopes : ndarray, shape (e, 2)
        b and c.
    """
    arms = np.stack([problem.levers.lateral_mm, problem.levers.lever_mm])
    return np.asarray(slopes @ arms - (slopes * shift_mm).sum(axis=1, keepdims=True))


def patch_distances(
    problem: MotionProblem, correlation: Float32Array, models: EchoModels
) -> tuple[FloatArray, FloatArray]:
    """Unsigned elevational distance of each patch of each pair and its standard deviation, shape (e, p), mm.

    NaN where a patch holds no distance. The deviation is by how much the distance changes over the
    correlation's.
    """
    curves, (share, gain) = problem.at_patches, models
    least = np.sqrt(np.maximum(LEAST_CORRELATION, curves.amplitude[:, -1] ** 2))

    def distances(rho: FloatArray) -> FloatArray:
        amplitude = (np.sqrt(np.maximum(rho, 0.0) / gain) - share) / (1.0 - share)
        columns = zip(np.where(amplitude > least, amplitude, np.nan).T, curves.amplitude, strict=True)
        return np.stack([np.interp(-a, -row, problem.curves.distance_mm) for a, row in columns], axis=1)

    limited = np.clip(correlation, 0.0, 0.999)
    noise = np.sqrt(correlation_variance(limited, curves.cells, curves.of_echo) + INTERPOLATION**2)
    nearer, distance, farther = (distances(correlation - side * noise) for side in (-1.0, 0.0, 1.0))
    sigma = np.where(np.isfinite(farther), (farther - nearer) / 2.0, distance - nearer)
    return distance, np.maximum(sigma, np.finfo(float).eps)
