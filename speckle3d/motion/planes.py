"""The plane through a frame pair's patches: the second frame seen from the first.

z(x, y) = a + b (x - xc) + c (y - yc) for points of the second frame, about the image's centre, where
b = R31 and c = R32 of the relative rotation. The plane is fitted to the correlations themselves, whose errors
are nearly Gaussian, and not to distances, which are skewed where speckle has all but gone and missing
where it has. Correlations know no sign; the plane returned has a >= 0, and the trajectory settles its sign.

Tilt is nearly invisible to decorrelation: a focused beam's wavefront is curved about the focus, so that
turning moves the speckle of all depths alike, and patches see a + c (y - yc - pivot) with a pivot that grows
with depth as y does. The fit keeps what is seen; `speckle3d.motion.uncertainty` weighs it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.kernels.planes import PlaneFit, fit_correlation_plane
from speckle3d.kernels.statistics import PatchCurves
from speckle3d.motion.distances import DistanceEstimator, EchoModel, PatchDistances

CROSSING_EVIDENCE = 6.0
"""Gain in twice the log-likelihood (a BIC) for which frames are taken to cross inside the image."""
OUTLYING = 9.0
"""Squared deviations at which a patch's misfit is capped. Where frames cross, correlation is known to a few
thousandths; one patch that lost it there would outvote all others."""
LOOSE_SLOPE = 0.05
"""Standard deviation of the slopes' prior, 3 degrees between frames that share speckle: keeps fits finite."""
SENSED_SLOPE = 5e-4
"""Standard deviation of slopes between near frames from a smoothed orientation sensor: 0.03 degrees."""
WELL_FITTED = 0.9
"""Squared deviations per patch below which no other hypothesis can do better by enough to matter."""
ROUNDS = 12
LEAST_PATCHES = 6
NEAR_MM = 0.15
"""Least distance at which fits start: correlation is flat at zero, and a fit from there takes distance for
tilt."""


class PlaneSettings(BaseModel):
    """How planes are fitted."""

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
class PairPlane:
    """Plane of one frame pair.

    Attributes
    ----------
    offset_mm, slope_x, slope_y : float
        a, b and c.
    covariance : ndarray, shape (3, 3)
        Of (a, b, c).
    used : ndarray of bool, shape (p,)
        Patches that took part.
    excess_mm, sigma_mm : ndarray, shape (p,)
        How much farther each patch is than the plane has it, and the standard deviation of that, both to
        first order in the correlation; NaN for patches that took no part.
    """

    offset_mm: float
    slope_x: float
    slope_y: float
    covariance: FloatArray
    used: BoolArray
    excess_mm: FloatArray
    sigma_mm: FloatArray

    @property
    def coefficients(self) -> FloatArray:
        """(a, b, c)."""
        return np.array([self.offset_mm, self.slope_x, self.slope_y])


class PlaneFitter:
    """Fits planes to the correlations of a sweep's frame pairs."""

    def __init__(
        self, estimator: DistanceEstimator, at_mm: FloatArray, settings: PlaneSettings | None = None
    ) -> None:
        self._estimator, self._at = estimator, at_mm
        self.settings = settings or PlaneSettings()
        self._curves = PatchCurves(estimator.amplitude, estimator.step_mm, estimator.cells, estimator.of_echo)
        zero = np.zeros(len(at_mm))
        tilt = estimator.tilt
        # Where the curves know nothing of tilt, it is taken to turn about the focus, and the focus to be at
        # the image's centre: all depths then see the centre's distance.
        self._lever = zero if tilt is None else at_mm[:, 1] - tilt.pivot_mm
        self._spread = zero if tilt is None else tilt.spread_mm

    def design(self, moved_mm: FloatArray) -> FloatArray:
        """What a, b and c are multiplied by for each patch, shape (p, 3).

        Parameters
        ----------
        moved_mm : ndarray, shape (2,)
            In-plane displacement of the second frame.
        """
        lateral = self._at[:, 0] - moved_mm[0]
        return np.column_stack([np.ones(len(lateral)), lateral, self._lever - moved_mm[1] * self._has_lever])

    @property
    def _has_lever(self) -> float:
        return float(self._estimator.tilt is not None)

    def fit(
        self,
        correlation: FloatArray,
        moved_mm: FloatArray,
        model: EchoModel | None = None,
        subset: BoolArray | None = None,
        slopes: FloatArray | None = None,
        start_mm: float | None = None,
        either_side: bool = True,
    ) -> PairPlane | None:
        """Robust maximum likelihood.

        None if fewer than six patches can take part, or if the image's centre comes to lie farther away than
        the curves were measured, or might.

        Parameters
        ----------
        correlation : ndarray, shape (p,)
        moved_mm : ndarray, shape (2,)
            In-plane displacement of the second frame.
        subset : ndarray of bool, shape (p,), optional
            Patches allowed to take part.
        slopes : ndarray, shape (2,), optional
            b and c as a sensor has them. The plane's sign is then theirs, and a may be negative.
        start_mm : float, optional
            About how far apart the frames are, if it is known.
        either_side : bool
            Whether a plane of known slopes may have a < 0.
        """
        model = model or EchoModel.fully_developed(correlation.size)
        used = np.isfinite(correlation) & self._measured(correlation, model)
        used = used if subset is None else used & subset
        if used.sum() < LEAST_PATCHES:
            return None
        rho = np.where(used, correlation, np.nan).astype(float)
        echo, design = model.table(), self.design(moved_mm)
        middle = self._middle(rho, model) if start_mm is None else max(start_mm, NEAR_MM)
        best, least = np.zeros(3), np.inf
        for number, (start, prior) in enumerate(self._starts(middle, design, used, slopes, either_side)):
            fitted = PlaneFit(start.copy(), np.empty((3, 3)), np.empty(rho.size), np.empty(rho.size))
            cost = fit_correlation_plane(
                rho, design, self._spread, echo, self._curves, prior, self.settings.huber, ROUNDS, fitted
            )
            plane, information, standard, sensitivity = fitted
            misfit = float(np.nansum(np.minimum(standard**2, OUTLYING)))
            misfit += CROSSING_EVIDENCE if number else 0.0
            if misfit < least:
                best, least, total, normal = plane, misfit, cost, information
                sigma = np.where(used, 1 / np.maximum(sensitivity, 1e-6), np.nan).astype(float)
                excess = np.asarray(-standard * sigma)
            if slopes is None and misfit < WELL_FITTED * used.sum():
                break
        covariance = np.linalg.inv(normal) * max(1.0, total / max(int(used.sum()) - 3, 1))
        covariance[0, 0] += self.settings.bias_mm**2
        # Where next to nothing of the echo is left, any distance fits as well: tens of metres have been seen.
        reach = self._estimator.reach_mm * max(1.0, float(np.median(model.stretch)))
        if not (abs(best[0]) <= reach and covariance[0, 0] <= reach**2):
            return None
        if best[0] < 0 and slopes is None:
            best = -best
        return PairPlane(
            float(best[0]), float(best[1]), float(best[2]), np.asarray(covariance, float), used, excess, sigma
        )

    def _measured(self, correlation: FloatArray, model: EchoModel) -> BoolArray:
        """Patches that correlate more than at their curve's last distance."""
        end = self._estimator.end_amplitude
        least = model.gain * (model.staying + model.moving * end) ** 2
        return np.asarray((end == 0.0) | (correlation > least))

    def _middle(self, rho: FloatArray, model: EchoModel) -> float:
        known = rho[np.isfinite(rho)]
        share = model.staying.mean()
        left = (np.sqrt(max(float(np.median(known)), 0.0)) - share) / max(1.0 - share, 0.1)
        return self._estimator.typical_distance(left)

    def _starts(
        self,
        middle: float,
        design: FloatArray,
        used: BoolArray,
        slopes: FloatArray | None,
        either_side: bool,
    ) -> list[tuple[FloatArray, FloatArray]]:
        """Starts with their priors: all patches on one side, then frames that cross within the image."""
        if slopes is not None:
            known = np.array([[0.0, *slopes], [1e-6, SENSED_SLOPE**-2, SENSED_SLOPE**-2]])
            sides = (1.0, -1.0) if either_side else (1.0,)
            return [(np.array([side * middle, *slopes]), known) for side in sides]
        loose = np.array([[0.0, 0.0, 0.0], [1e-6, LOOSE_SLOPE**-2, LOOSE_SLOPE**-2]])
        starts = [np.array([middle, 0.0, 0.0])]
        lateral = design[used, 1]
        half = np.ptp(lateral) / 2
        # V-shaped distances, which no plane on one side explains, fall towards the crossing.
        if half > 0 and middle < LOOSE_SLOPE * half:
            for at in (-0.5, 0.0, 0.5):
                centre = lateral.mean() + at * half
                slope = middle / np.abs(lateral - centre).mean()
                starts.append(np.array([-slope * centre, slope, 0.0]))
        return [(start, loose) for start in starts]


def consistent_subset(
    distances: PatchDistances, raised_mm: FloatArray, support_sigma: float = 1.0, either_side: bool = True
) -> BoolArray:
    """Patches whose distances agree on one plane of the orientation that the sensor measured.

    Every patch in turn places the plane, through +d and through -d; the placement that most others agree
    with, in magnitude and within `support_sigma` of their own deviations, keeps its supporters.

    Parameters
    ----------
    raised_mm : ndarray, shape (p,)
        How much farther each patch is than the image's centre, by the sensor's relative rotation.
    either_side : bool
        Whether the image's centre may lie on the other side of the first frame than `raised_mm` has it.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, "Sensorless drift correction using
       orientation measurements", figure 4.
    """
    d, sigma = distances.distance_mm, distances.sigma_mm
    known = np.flatnonzero(np.isfinite(d))
    support = np.zeros(len(d), dtype=bool)
    if known.size == 0:
        return support
    raised = raised_mm[known]
    sides = (1.0, -1.0) if either_side else (1.0,)
    offsets = np.concatenate([side * d[known] - raised for side in sides])
    distance = np.abs(offsets[:, None] + raised)
    error = np.abs(distance - d[known]) / sigma[known]
    agree = error <= support_sigma
    # Among placements of equal support, the one whose supporters lie closest.
    score = agree.sum(axis=1) - np.where(agree, error, 0.0).sum(axis=1) / (agree.shape[1] * support_sigma + 1)
    best = int(np.argmax(score))
    support[known] = agree[best]
    return support
