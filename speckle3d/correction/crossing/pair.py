"""Scale and turns of two crossing sweeps, found by making their images agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.geometry import mirrored
from speckle3d.core.shown import shown
from speckle3d.correction.crossing.fit import CrossingFit, Parts, Prior, covariance
from speckle3d.correction.crossing.planes import (
    BENDS,
    ORDERS,
    SPACING_MM,
    StraightSweep,
    relative_turn,
    straightened,
)
from speckle3d.correction.crossing.search import candidates
from speckle3d.correction.crossing.similarity import PARAMETERS, RIGID, BlurredSweep, Placing
from speckle3d.correction.crossing.sweep import CrossingSettings, CrossingSweep
from speckle3d.correction.drift import correct_orientation
from speckle3d.correction.scale import ScaledPoses, ScaleEvidence

_STARTS = 4
"""Candidates refined."""
_CELL = (2.0 * np.sqrt(np.pi)) ** 3
"""Volume that counts as one comparison under a Gaussian blur of unit standard deviation."""
_FEWEST, _PER_CELL = 3000, 12.0
"""Points looked up: at least so many, and so many for each such volume."""
_FOLLOWED = 0.45
"""Displacement over blur above which residuals no longer follow it: at 0.9 mm, 0.6 mm rms are taken for 0.46
and 1.0 mm for 0.62, and lengths came out wrong by up to 8 %. Of 0.3 mm at most 0.41 were made."""
_INCLINATION_RAD, _HEADING_RAD = np.deg2rad([0.15, 0.5])
"""How far a sensor's slow errors change over a sweep, standard deviation: about horizontal axes and about the
vertical."""
_BETWEEN_INCLINATION_RAD, _BETWEEN_HEADING_RAD = np.deg2rad([1.0, 8.0])
"""The same between two sweeps: minutes apart, the probe, and its iron, turned in the earth's field."""


@shown
@dataclass(frozen=True)
class CrossingSoFar:
    """How two sweeps lie to each other, whether or not a length can be claimed from it.

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
    """Two sweeps after their images have been made to agree.

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


def crossed(
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
    return _Crossing.of(first, second, settings or CrossingSettings()).judged()


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

    given: tuple[CrossingSweep, CrossingSweep]
    settings: CrossingSettings
    sides: tuple[StraightSweep, StraightSweep]
    mirrored: tuple[bool, bool]
    coarse: CrossingFit
    fit: CrossingFit
    margin: float

    @classmethod
    def of(cls, first: CrossingSweep, second: CrossingSweep, settings: CrossingSettings) -> _Crossing:
        """Find the likeliest place."""
        given = first, second
        side = cache(lambda which, flipped: straightened(_turned(given[which], flipped), settings.nearest_mm))
        starts = candidates(side, settings.depth_shift_mm, _STARTS)
        if not starts:
            raise MismatchError(
                f"{first.name} and {second.name}: expected sweeps that cross over the same tissue, got none "
                "of it in common; sweep twice over one place, the probe turned by 90 degrees"
            )
        fit_at = _fitter(given, side, settings)
        *coarse, finest = settings.blurs_mm
        ends = []
        for start in starts:
            placing = start.placing
            for blur_mm in coarse or [finest]:
                end = fit_at(blur_mm, start.mirrored, placing).refined()
                placing = end.placing
            ends.append((start.mirrored, end))
        ends.sort(key=lambda each: -each[1].log_likelihood)
        flips, best = ends[0]
        others = [
            end.log_likelihood
            for flipped, end in ends[1:]
            if flipped != flips or not end.placing.is_near(best.placing, 3.0, np.deg2rad(6.0))
        ]
        fit = fit_at(finest, flips, best.placing).refined()
        seen = fit_at((coarse or [finest])[-1], flips, fit.placing)
        sides = side(0, flips[0]), side(1, flips[1])
        return cls(
            given, settings, sides, flips, seen, fit, best.log_likelihood - max(others, default=-np.inf)
        )

    @property
    def so_far(self) -> CrossingSoFar:
        """How the sweeps lie to each other."""
        return CrossingSoFar(self.fit.correlation, self.fit.angle_deg, self.fit.overlap_mm(SPACING_MM))

    def judged(self) -> CrossedPair:
        """The pair, if its length may be claimed."""
        limits, so_far = self.settings, self.so_far
        moved = Parts.of(self.coarse).moved_mm(self.coarse.matrix)
        most = _FOLLOWED * limits.blurs_mm[max(0, len(limits.blurs_mm) - 2)]
        whole = covariance(self.fit, moved)
        scaled = [self._scaled(which, whole, moved) for which in (0, 1)]
        sigma = max(each.log_scale_sigma for each in scaled)
        figures = vars(limits) | vars(so_far) | {"margin": self.margin, "moved": moved, "most": most}
        figures |= {"sigma": 100 * sigma, "largest": 100 * limits.largest_sigma}
        for wrong, error, words in (
            (
                so_far.similarity < limits.least_similarity,
                MismatchError,
                "images that agree where the sweeps cross, got a correlation of {similarity:.2f}; was the "
                "same tissue swept, and did it stay as it was?",
            ),
            (
                so_far.angle_deg < limits.least_angle_deg,
                InsufficientDataError,
                "sweeps that cross by {least_angle_deg:.0f} degrees or more, got {angle_deg:.0f}; turn the "
                "probe by 90 degrees between them",
            ),
            (
                so_far.overlap_mm < limits.least_overlap_mm,
                InsufficientDataError,
                "{least_overlap_mm:.0f} mm of each sweep to be seen by the other, got {overlap_mm:.0f}; let "
                "longer sweeps cross in their middles",
            ),
            (
                self.margin < limits.least_margin,
                MismatchError,
                "one way of laying the sweeps together, got another that fits almost as well (log likelihood "
                "{margin:.0f} less); sweep where vessels or edges tell places apart",
            ),
            (
                moved > most,
                InsufficientDataError,
                "tissue that stayed within {most:.2f} mm rms between sweeps, got some that moved by "
                "{moved:.2f} mm rms where they cross; sweep again with less pressure, more gel and the "
                "breath held",
            ),
            (
                sigma > limits.largest_sigma,
                InsufficientDataError,
                "parts of the tissue to agree on the length to {largest:.1f} %, got {sigma:.1f} %, with "
                "{moved:.2f} mm rms of movement between the sweeps; sweep again over more texture, with less "
                "pressure",
            ),
        ):
            if wrong:
                names = f"{self.given[0].name} and {self.given[1].name}"
                raise error(f"{names}: expected {words.format(**figures)}")
        to_world = [each.poses[0] * self._centred_frames(which)[0].inv() for which, each in enumerate(scaled)]
        return CrossedPair(
            **vars(so_far),
            first=scaled[0],
            second=scaled[1],
            first_from_second=to_world[0] * self.fit.placing.first_from_second * to_world[1].inv(),
            mirrored=self.mirrored,
            frame_time_s=(self.given[0].frame_time_s, self.given[1].frame_time_s),
        )

    def _centred_frames(self, which: int) -> RigidTransform:
        """Path from image of every frame."""
        back = RigidTransform.from_translation(-self.given[which].centre_mm)
        return self.sides[which].bent_frames(self.fit.placing.bends[which]) * back

    def _scaled(self, which: int, whole: FloatArray, moved_mm: float) -> ScaledPoses:
        sensed, side, bends = self.given[which].sensed, self.sides[which], self.fit.placing.bends[which]
        poses = self._centred_frames(which)
        if sensed is None:
            poses = poses[0].inv() * poses
        else:
            # The correction's mean turn is the sensor's to tell.
            poses = RigidTransform.from_rotation((sensed * poses.rotation.inv()).mean()) * poses
            poses = RigidTransform.from_translation(-poses.translation[0]) * poses
        own = slice(RIGID + which * BENDS, RIGID + (which + 1) * BENDS)
        rates = side.mean_rates()
        scale = 1.0 + float(rates[0] @ bends)
        terms = rates / scale
        values = np.array([np.log(scale), *(terms[1:] @ bends)])
        before = np.linalg.inv(self.fit.prior.information[RIGID:, RIGID:])
        before = before[which * BENDS :, which * BENDS :][:BENDS, :BENDS]
        after, prior = (np.linalg.inv(terms @ each @ terms.T) for each in (whole[own, own], before))
        size, axes = np.linalg.eigh(after - prior)
        information = (axes * np.maximum(size, 0.0)) @ axes.T
        evidence = ScaleEvidence("crossing", np.linalg.pinv(information) @ after @ values, information)
        chain = side.frames
        slopes = chain.frame_errors(bends, chain.poses(bends), np.zeros(3))
        return ScaledPoses(
            poses,
            slopes @ whole[own, own] @ slopes.transpose(0, 2, 1),
            float(values[0]),
            float(np.sqrt(np.linalg.inv(after)[0, 0])),
            (evidence,),
            {"similarity": self.fit.correlation, "tissue_moved_mm": moved_mm},
        )


def _turned(sweep: CrossingSweep, flipped: bool) -> CrossingSweep:
    """The sweep, perhaps having gone the other way, with slow turns by its sensor if there is one."""
    poses = mirrored(sweep.poses) if flipped else sweep.poses
    if sweep.sensed is not None:
        every = np.ones(len(poses), dtype=bool)
        poses = correct_orientation(poses, sweep.sensed, every, sweep.centre_mm).poses
    return replace(sweep, poses=poses)


def _fitter(
    given: tuple[CrossingSweep, CrossingSweep],
    side: Callable[[int, bool], StraightSweep],
    settings: CrossingSettings,
) -> Callable[[float, tuple[bool, bool], Placing], CrossingFit]:
    """Function of blur, mirroring and placing that compares the sweeps there."""

    @cache
    def at_blur(blur_mm: float, flips: tuple[bool, bool]) -> tuple[list[BlurredSweep], Prior, float]:
        sides = [side(which, flipped) for which, flipped in enumerate(flips)]
        volume = min(float(np.isfinite(s.texture).sum() * s.spacing_mm.prod()) for s in sides)
        cells = volume / (_CELL * blur_mm**3)
        points = int(min(settings.samples, max(_FEWEST, _PER_CELL * cells)))
        pair = [BlurredSweep.of(each, blur_mm, points) for each in sides]
        return pair, _prior(given, sides, settings), min(settings.effective_samples, cells)

    def fit_at(blur_mm: float, flips: tuple[bool, bool], placing: Placing) -> CrossingFit:
        pair, prior, independent = at_blur(blur_mm, flips)
        return CrossingFit(pair, placing, prior, independent)

    return fit_at


def _prior(
    given: tuple[CrossingSweep, CrossingSweep], sides: list[StraightSweep], settings: CrossingSettings
) -> Prior:
    spread = np.zeros((2 * BENDS, 2 * BENDS))
    for which, (sweep, side) in enumerate(zip(given, sides, strict=True)):
        rates = np.full(2, sweep.turn_sigma_per_mm)
        if sweep.sensed is not None:
            up = sweep.sensed.inv().apply([0.0, 0.0, 1.0]).mean(axis=0)
            share = (up / np.linalg.norm(up))[:2] ** 2
            over = np.sqrt(_INCLINATION_RAD**2 * (1.0 - share) + _HEADING_RAD**2 * share)
            # A drift from -1 to 1 along the sweep has a standard deviation of 1 / sqrt(3).
            rates = np.minimum(rates, 2.0 * np.sqrt(3.0) * over / side.length_mm)
        own = slice(which * BENDS, (which + 1) * BENDS)
        spread[own, own] = np.diag(np.repeat([settings.tissue_sigma, *rates], ORDERS) ** 2)
    # Probe and curves are the same: so is the error of the scale.
    spread[np.ix_([0, BENDS], [0, BENDS])] += given[0].scale_sigma * given[1].scale_sigma
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
    return Prior(information, turn)
