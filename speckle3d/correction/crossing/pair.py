"""Estimate scale and rotation of two crossing sweeps by registration of their images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.geometry import mirrored
from speckle3d.core.text import shown
from speckle3d.correction.crossing.fit import CrossingFit, CubeSums, PathPrior, covariance
from speckle3d.correction.crossing.planes import (
    BENDS,
    ORDERS,
    StraightSweep,
    relative_turn,
    straighten,
)
from speckle3d.correction.crossing.search import candidates
from speckle3d.correction.crossing.similarity import PARAMETERS, RIGID, BlurredSweep, Placing
from speckle3d.correction.crossing.sweep import CrossingSettings, CrossingSweep
from speckle3d.correction.drift import correct_orientation
from speckle3d.correction.scale import ScaledPoses, ScaleEvidence
from speckle3d.correction.settings import FusedSettings

_STARTS = 4
"""Candidates refined. The best alone gives the same lengths, and does not tell whether another place fits."""
_LARGEST_SHARE = 0.45
"""Displacement over blur above which residuals no longer follow it: at 0.9 mm, 0.6 mm rms are taken for 0.46
and 1.0 mm for 0.62, and lengths came out wrong by up to 8 %. Of 0.3 mm at most 0.41 were made."""
_SENSOR = FusedSettings()
"""How far a sensor's slow errors change over a sweep."""
_BETWEEN_INCLINATION_RAD, _BETWEEN_HEADING_RAD = np.deg2rad([1.0, 8.0])
"""How far they do between two: minutes apart, the probe, and its iron, turned in the earth's field."""


@shown
@dataclass(frozen=True)
class CrossingSoFar:
    """Relative position of two sweeps so far, sufficient for a length or not.

    Attributes
    ----------
    similarity : float
        Correlation of both sweeps' images where they cross.
    angle_deg, overlap_mm : float
        Angle at which they cross; length along either sweep, the lesser, that the other sees.
    """

    similarity: float
    angle_deg: float
    overlap_mm: float


@shown
@dataclass(frozen=True)
class CrossedPair(CrossingSoFar):
    """Two registered crossing sweeps.

    Attributes
    ----------
    first, second : ScaledPoses
        In the sensor's world if the sweep's orientation was sensed, else its first frame is the identity.
    first_from_second : RigidTransform
        Between the worlds of their poses.
    mirrored : tuple of bool
        Which of the sweeps went the other way than its poses said: images alone do not know the sign of the
        elevational motion. Without sensed orientation the first is taken at its word.
    frame_time_s : tuple of (ndarray or None)
        Of each sweep.
    """

    first: ScaledPoses
    second: ScaledPoses
    first_from_second: RigidTransform
    mirrored: tuple[bool, bool]
    frame_time_s: tuple[FloatArray | None, FloatArray | None]

    def of(self, frame_time_s: FloatArray, name: str) -> ScaledPoses:
        """The poses of the sweep whose frames have these times.

        Raises
        ------
        MismatchError
            If neither sweep's frames do.
        """
        for poses, times in zip((self.first, self.second), self.frame_time_s, strict=True):
            if times is not None and np.array_equal(times, frame_time_s):
                return poses
        raise MismatchError(
            f"{name}: expected one of the two crossed sweeps, all of its frames, got another or a part"
        )


def solve_crossing(
    first: CrossingSweep, second: CrossingSweep, settings: CrossingSettings | None = None
) -> CrossedPair:
    """Find the elevational scale of two sweeps that cross over the same tissue.

    Parameters
    ----------
    first, second : CrossingSweep
    settings : CrossingSettings, optional

    Raises
    ------
    InsufficientDataError
        If angle, overlap, texture or agreement are too little for a length to be claimed.
    MismatchError
        If the sweeps do not show the same tissue, or more than one way of laying them together fits.
    """
    return _Crossing.of(first, second, settings or CrossingSettings()).pair()


def crossing_so_far(
    first: CrossingSweep, second: CrossingSweep, settings: CrossingSettings | None = None
) -> CrossingSoFar:
    """Lay two sweeps together, one of which may still be going on.

    Raises
    ------
    MismatchError
        If no place is found that both may show.
    """
    return _Crossing.of(first, second, settings or CrossingSettings()).so_far


@dataclass(frozen=True)
class _Crossing:
    """Two sweeps laid together.

    Attributes
    ----------
    sides : tuple of StraightSweep
        As they went.
    coarse, fit : CrossingFit
        Under the last blur but one, and the last.
    margin : float
        By how much the log likelihood exceeds that of another place.
    """

    sweeps: tuple[CrossingSweep, CrossingSweep]
    settings: CrossingSettings
    sides: list[StraightSweep]
    mirrored: tuple[bool, bool]
    coarse: CrossingFit
    fit: CrossingFit
    margin: float

    @classmethod
    def of(cls, first: CrossingSweep, second: CrossingSweep, settings: CrossingSettings) -> _Crossing:
        """Find the likeliest place."""
        sweeps = first, second
        side = cache(lambda number, flip: straighten(_prepare(sweeps[number], flip), settings.nearest_mm))
        starts = candidates(side, settings.depth_shift_mm, _STARTS)
        if not starts:
            raise MismatchError(
                f"{first.name} and {second.name}: expected sweeps that cross over the same tissue, got none "
                "of it in common; sweep twice over one place, the probe turned by 90 degrees"
            )
        blurs_mm = settings.blurs_mm

        @cache
        def comparison(
            blur_mm: float, flips: tuple[bool, bool]
        ) -> tuple[list[BlurredSweep], PathPrior, float]:
            sides = [side(number, flip) for number, flip in enumerate(flips)]
            return _comparison(sweeps, sides, blur_mm, settings)

        def fit_at(blur_mm: float, flips: tuple[bool, bool], placing: Placing) -> CrossingFit:
            pair, prior, independent = comparison(blur_mm, flips)
            return CrossingFit(pair, placing, prior, independent)

        ends = []
        for placing, flips, _ in starts:
            for blur_mm in blurs_mm[:-1] or blurs_mm:
                end = fit_at(blur_mm, flips, placing).refine()
                placing = end.placing
            ends.append((flips, end))
        flips, best = max(ends, key=lambda item: item[1].log_likelihood)
        rivals = [
            end.log_likelihood
            for mirrored, end in ends
            if mirrored != flips or not end.placing.is_near(best.placing, 3.0, np.deg2rad(6.0))
        ]
        fit = fit_at(blurs_mm[-1], flips, best.placing).refine()
        coarse = fit_at(blurs_mm[-2:][0], flips, fit.placing)
        sides = [side(number, flip) for number, flip in enumerate(flips)]
        margin = best.log_likelihood - max(rivals, default=-np.inf)
        return cls(sweeps, settings, sides, flips, coarse, fit, margin)

    @property
    def so_far(self) -> CrossingSoFar:
        """Relative position of the two sweeps."""
        return CrossingSoFar(self.fit.correlation, self.fit.angle_deg, self.fit.overlap_mm)

    def pair(self) -> CrossedPair:
        """The pair, if its length may be claimed."""
        limits, so_far = self.settings, self.so_far
        displacement_mm = CubeSums.of(self.coarse).displacement_mm(self.coarse.normal_equations[0])
        most_mm = _LARGEST_SHARE * limits.blurs_mm[-2:][0]
        uncertainty = covariance(self.fit, displacement_mm)
        poses = [self._scaled_poses(number, uncertainty, displacement_mm) for number in (0, 1)]
        sigma = max(side.length_sigma for side in poses)
        for wrong, error, expectation in (
            (
                so_far.similarity < limits.least_similarity,
                MismatchError,
                f"images that agree where the sweeps cross, got a correlation of {so_far.similarity:.2f}; "
                "was the same tissue swept, and did it stay as it was?",
            ),
            (
                so_far.angle_deg < limits.least_angle_deg,
                InsufficientDataError,
                f"sweeps that cross by {limits.least_angle_deg:.0f} degrees or more, got "
                f"{so_far.angle_deg:.0f}; turn the probe by 90 degrees between them",
            ),
            (
                so_far.overlap_mm < limits.least_overlap_mm,
                InsufficientDataError,
                f"{limits.least_overlap_mm:.0f} mm of each sweep to be seen by the other, got "
                f"{so_far.overlap_mm:.0f}; let longer sweeps cross in their middles",
            ),
            (
                self.margin < limits.least_margin,
                MismatchError,
                "one way of laying the sweeps together, got another that fits almost as well (log likelihood "
                f"{self.margin:.0f} less); sweep where vessels or edges tell places apart",
            ),
            (
                displacement_mm > most_mm,
                InsufficientDataError,
                f"tissue that stayed within {most_mm:.2f} mm rms between sweeps, got some that moved by "
                f"{displacement_mm:.2f} mm rms where they cross; sweep again with less pressure, more gel "
                "and the breath held",
            ),
            (
                sigma > limits.largest_sigma,
                InsufficientDataError,
                f"parts of the tissue to agree on the length to {100 * limits.largest_sigma:.1f} %, got "
                f"{100 * sigma:.1f} %, with {displacement_mm:.2f} mm rms of movement between the sweeps; "
                "sweep again over more texture, with less pressure",
            ),
        ):
            if wrong:
                raise error(f"{self.sweeps[0].name} and {self.sweeps[1].name}: expected {expectation}")
        worlds = [side.poses[0] * self._path_from_images(n)[0].inv() for n, side in enumerate(poses)]
        return CrossedPair(
            **vars(so_far),
            first=poses[0],
            second=poses[1],
            first_from_second=worlds[0] * self.fit.placing.first_from_second * worlds[1].inv(),
            mirrored=self.mirrored,
            frame_time_s=(self.sweeps[0].frame_time_s, self.sweeps[1].frame_time_s),
        )

    def _path_from_images(self, number: int) -> RigidTransform:
        """Poses of all frames of a sweep on its bent path."""
        back = RigidTransform.from_translation(-self.sweeps[number].centre_mm)
        return self.sides[number].bent_frames(self.fit.placing.bends[number]) * back

    def _scaled_poses(self, number: int, uncertainty: FloatArray, displacement_mm: float) -> ScaledPoses:
        orientation, bends = self.sweeps[number].orientation, self.fit.placing.bends[number]
        poses = self._path_from_images(number)
        if orientation is None:
            poses = poses[0].inv() * poses
        else:
            # The correction's mean turn is the sensor's to tell.
            poses = RigidTransform.from_rotation((orientation * poses.rotation.inv()).mean()) * poses
            poses = RigidTransform.from_translation(-poses.translation[0]) * poses
        prior = np.linalg.inv(self.fit.prior.information[RIGID:, RIGID:])
        block = slice(number * BENDS, (number + 1) * BENDS)
        before, after = prior[block, block], uncertainty[RIGID:, RIGID:][block, block]
        rates = self.sides[number].mean_rates()
        scale = 1.0 + float(rates[0] @ bends)
        terms = rates / scale
        values = np.array([np.log(scale), *(terms[1:] @ bends)])
        posterior, expectation = (np.linalg.inv(terms @ bend @ terms.T) for bend in (after, before))
        size, axes = np.linalg.eigh(posterior - expectation)
        information = (axes * np.maximum(size, 0.0)) @ axes.T
        evidence = ScaleEvidence(np.linalg.pinv(information) @ posterior @ values, information)
        chain = self.sides[number].frames
        slopes = chain.frame_errors(bends, chain.poses(bends))
        return ScaledPoses(
            poses,
            slopes @ after @ slopes.transpose(0, 2, 1),
            float(values[0]),
            float(np.sqrt(np.linalg.inv(posterior)[0, 0])),
            ("images", "crossing"),
            evidence,
            {"similarity": self.fit.correlation, "tissue_moved_mm": displacement_mm},
        )


def _prepare(sweep: CrossingSweep, flip: bool) -> CrossingSweep:
    """The sweep, perhaps having gone the other way, with slow turns by its sensor if there is one."""
    poses = mirrored(sweep.poses) if flip else sweep.poses
    if sweep.orientation is not None:
        every = np.ones(len(poses), dtype=bool)
        poses = correct_orientation(poses, sweep.orientation, every, sweep.centre_mm).poses
    return replace(sweep, poses=poses)


def _comparison(
    sweeps: Sequence[CrossingSweep],
    sides: Sequence[StraightSweep],
    blur_mm: float,
    settings: CrossingSettings,
) -> tuple[list[BlurredSweep], PathPrior, float]:
    """Both sweeps under one blur, the prior of how they lie, and how many comparisons they are worth."""
    volume = min(float(np.isfinite(s.texture).sum() * s.spacing_mm.prod()) for s in sides)
    # Under a Gaussian blur so much volume counts as one comparison.
    cells = volume / (2.0 * np.sqrt(np.pi) * blur_mm) ** 3
    pair = [BlurredSweep.of(side, blur_mm, settings.samples) for side in sides]
    return pair, _prior(sweeps, sides, settings), min(settings.effective_samples, cells)


def _prior(
    sweeps: Sequence[CrossingSweep], sides: Sequence[StraightSweep], settings: CrossingSettings
) -> PathPrior:
    spread = np.zeros((2 * BENDS, 2 * BENDS))
    for number, (sweep, side) in enumerate(zip(sweeps, sides, strict=True)):
        rates = np.full(2, sweep.turn_sigma_per_mm)
        if sweep.orientation is not None:
            up = sweep.orientation.inv().apply([0.0, 0.0, 1.0]).mean(axis=0)
            share = (up / np.linalg.norm(up))[:2] ** 2
            level, heading = _SENSOR.inclination_sigma_rad, _SENSOR.heading_sigma_rad
            over = np.sqrt(level**2 * (1.0 - share) + heading**2 * share)
            # A drift from -1 to 1 along the sweep has a standard deviation of 1 / sqrt(3).
            rates = np.minimum(rates, 2.0 * np.sqrt(3.0) * over / side.length_mm)
        block = slice(number * BENDS, (number + 1) * BENDS)
        spread[block, block] = np.diag(
            np.repeat([settings.tissue_sigma, *rates, sweep.sideways_per_mm], ORDERS) ** 2
        )
    # Probe and curves are the same: so is the error of the scale.
    spread[np.ix_([0, BENDS], [0, BENDS])] += sweeps[0].scale_sigma * sweeps[1].scale_sigma
    # A kilometre and 1000 radians of place and turn: as good as nothing.
    information = 1e-6 * np.eye(PARAMETERS)
    information[RIGID:, RIGID:] = np.linalg.inv(spread)
    turn, world = relative_turn(sides[0], sides[1]), sides[0].world
    if turn is not None and world is not None:
        up = world.inv().apply([0.0, 0.0, 1.0])
        vertical = np.outer(up, up)
        information[3:RIGID, 3:RIGID] = (
            vertical / _BETWEEN_HEADING_RAD**2 + (np.eye(3) - vertical) / _BETWEEN_INCLINATION_RAD**2
        )
    return PathPrior(information, turn)
