"""Scale and turns of two crossing sweeps, found by making their images agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.errors import InsufficientDataError, MismatchError, Speckle3DError
from speckle3d.core.shown import shown
from speckle3d.correction.crossing.certainty import angle_deg, bend_slice, covariance, overlap_mm, terms_of
from speckle3d.correction.crossing.moved import Parts, rms_mm
from speckle3d.correction.crossing.path import BENDS, StraightSweep, straightened
from speckle3d.correction.crossing.refine import Prior, Refined, refined
from speckle3d.correction.crossing.search import (
    Candidate,
    Hypothesis,
    candidates,
    same_place,
    turns_about_beam,
)
from speckle3d.correction.crossing.sensed import relative_turn, slow_error_per_mm, turned
from speckle3d.correction.crossing.similarity import Textured
from speckle3d.correction.crossing.sweep import CrossingSettings, CrossingSweep
from speckle3d.correction.crossing.texture import at_blur, prefiltered
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


@shown
@dataclass(frozen=True)
class CrossedPair:
    """Two sweeps after their images have been made to agree.

    Attributes
    ----------
    first, second : ScaledPoses
        In the sensor's world if the sweep's orientation was sensed, else its first frame is the identity.
    first_from_second : RigidTransform
        Between the worlds of their poses.
    log_scale_bends : ndarray, shape (2, 3)
        Legendre coefficients along the signed elevational travel of the logarithm of each sweep's scale.
    covariance : ndarray, shape (6, 6)
        Joint, of `speckle3d.correction.scale.TERMS` of the first sweep and of the second.
    similarity : float
        Correlation of both sweeps' images where they cross.
    overlap_mm, angle_deg : float
        Length along either sweep, the lesser, that the other sees; angle at which they cross.
    mirrored : tuple of bool
        Which of the sweeps went the other way than its poses said: images alone do not know the sign of the
        elevational motion. Without sensed orientation the first is taken at its word.
    frame_time_s : tuple of (ndarray or None)
        Of each sweep.
    details : dict of str to float or str
        For tables and reports.
    """

    first: ScaledPoses
    second: ScaledPoses
    first_from_second: RigidTransform
    log_scale_bends: FloatArray
    covariance: FloatArray
    similarity: float
    overlap_mm: float
    angle_deg: float
    mirrored: tuple[bool, bool]
    frame_time_s: tuple[FloatArray | None, FloatArray | None] = (None, None)
    details: dict[str, float | str] = field(default_factory=dict)

    def of(self, frame_time_s: FloatArray, name: str) -> ScaledPoses:
        """The poses of the sweep whose frames have these times.

        Raises
        ------
        MismatchError
            If neither sweep's frames do.
        """
        for poses, times in zip((self.first, self.second), self.frame_time_s, strict=True):
            if np.array_equal(frame_time_s if times is None else times, frame_time_s) and len(
                poses.poses
            ) == len(frame_time_s):
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
    chosen = settings or CrossingSettings()
    matched = _Matched.of(first, second, chosen)
    best, other = matched.found()
    return matched.judged(best, other)


@dataclass(frozen=True)
class CrossingSoFar:
    """How two sweeps lie to each other, whether or not a length can be claimed from it.

    Attributes
    ----------
    similarity : float
        Correlation of both sweeps' images where they cross.
    angle_deg, overlap_mm : float
        As of `CrossedPair`.
    """

    similarity: float
    angle_deg: float
    overlap_mm: float


def crossing_so_far(
    first: CrossingSweep, second: CrossingSweep, settings: CrossingSettings | None = None
) -> CrossingSoFar:
    """Lay two sweeps together, one of which may still be going on.

    Raises
    ------
    MismatchError
        If no place is found that both may show.
    """
    matched = _Matched.of(first, second, settings or CrossingSettings())
    (start, end), _ = matched.found()
    pair = matched.at(matched.settings.blurs_mm[-1], start.mirrored)
    return CrossingSoFar(end.correlation, angle_deg(end), overlap_mm(end, pair))


@dataclass(frozen=True)
class _Matched:
    """Both sweeps made ready: as given and mirrored."""

    given: tuple[CrossingSweep, CrossingSweep]
    sweeps: Sequence[Sequence[StraightSweep]]
    textures: Sequence[Sequence[Float32Array]]
    prior: Prior
    hypotheses: Sequence[Hypothesis]
    settings: CrossingSettings

    @classmethod
    def of(cls, first: CrossingSweep, second: CrossingSweep, settings: CrossingSettings) -> _Matched:
        sweeps, textures = [], []
        for each in (first, second):
            straight = straightened(turned(each), settings.nearest_mm)
            texture = prefiltered(straight.volume, straight.spacing_mm)
            sweeps.append((straight, straight.mirrored()))
            textures.append((texture, np.ascontiguousarray(texture[::-1])))
        turn, information = relative_turn(first, second, [s[0] for s in sweeps])
        prior = Prior(
            np.asarray(np.linalg.inv(_bend_covariance(first, second, sweeps, settings))), turn, information
        )
        hypotheses = turns_about_beam()
        if turn is not None:
            hypotheses = [Hypothesis(turn, (one, other)) for one in (False, True) for other in (False, True)]
        return cls((first, second), sweeps, textures, prior, hypotheses, settings)

    def at(self, blur_mm: float, mirrored: tuple[bool, bool]) -> list[Textured]:
        """Both sweeps at one blur."""
        return [
            Textured.of(
                self.sweeps[k][flip],
                at_blur(self.textures[k][flip], blur_mm, self.sweeps[k][flip].spacing_mm),
                int(min(self.settings.samples, max(_FEWEST, _PER_CELL * self.cells(blur_mm)))),
            )
            for k, flip in enumerate(mirrored)
        ]

    def independent(self, blur_mm: float) -> float:
        """How many comparisons the sweeps are worth at a blur."""
        return min(self.settings.effective_samples, self.cells(blur_mm))

    def cells(self, blur_mm: float) -> float:
        """How many cells of a blur fit into the smaller sweep."""
        volume = min(
            float(np.isfinite(t[0]).sum() * s[0].spacing_mm.prod())
            for s, t in zip(self.sweeps, self.textures, strict=True)
        )
        return float(volume / (_CELL * blur_mm**3))

    def found(self) -> tuple[tuple[Candidate, Refined], float]:
        """The best candidate refined, and by how much its log likelihood exceeds that of another place."""
        starts = candidates(
            self.sweeps, self.textures, self.hypotheses, self.settings.depth_shift_mm, _STARTS
        )
        if not starts:
            raise MismatchError(
                f"{self.given[0].name} and {self.given[1].name}: expected sweeps that cross over the same "
                "tissue, got none of it in common; sweep twice over one place, the probe turned by 90 degrees"
            )
        *coarse, finest = self.settings.blurs_mm
        levels: dict[tuple[float, tuple[bool, bool]], list[Textured]] = {}
        ends = []
        for start in starts:
            placing = start.placing
            for blur in coarse or [finest]:
                key = blur, start.mirrored
                if key not in levels:
                    levels[key] = self.at(*key)
                end = refined(levels[key], placing, self.prior, self.independent(blur))
                placing = end.placing
            ends.append((start, end))
        ends.sort(key=lambda each: -each[1].log_likelihood)
        start, end = ends[0]
        others = [
            e.log_likelihood
            for s, e in ends[1:]
            if s.mirrored != start.mirrored or not same_place(e.placing, end.placing, 3.0, np.deg2rad(6.0))
        ]
        margin = end.log_likelihood - max(others) if others else float("inf")
        best = refined(self.at(finest, start.mirrored), end.placing, self.prior, self.independent(finest))
        return (start, best), margin

    def judged(self, best: tuple[Candidate, Refined], margin: float) -> CrossedPair:
        """The pair, if its length may be claimed."""
        start, end = best
        limits, mirrored = self.settings, start.mirrored
        pair = self.at(limits.blurs_mm[-1], mirrored)
        angle, overlap = angle_deg(end), overlap_mm(end, pair)
        moved, blur = self.moved_mm(end, mirrored)
        whole = covariance(end, self.prior, moved)
        terms = np.concatenate([terms_of(pair[k].path, k) for k in (0, 1)])
        joint = terms @ whole @ terms.T
        sigma = float(np.sqrt(joint[[0, 3], [0, 3]].max()))
        requirements: tuple[tuple[bool, type[Speckle3DError], str], ...] = (
            (
                end.correlation >= limits.least_similarity,
                MismatchError,
                "images that agree where the sweeps cross, got a correlation of "
                f"{end.correlation:.2f}; was the "
                "same tissue swept, and did it stay as it was?",
            ),
            (
                angle >= limits.least_angle_deg,
                InsufficientDataError,
                f"sweeps that cross by {limits.least_angle_deg:.0f} degrees or more, got "
                f"{angle:.0f}; turn the "
                "probe by 90 degrees between them",
            ),
            (
                overlap >= limits.least_overlap_mm,
                InsufficientDataError,
                f"{limits.least_overlap_mm:.0f} mm of each sweep to be seen by the other, got "
                f"{overlap:.0f}; let "
                "longer sweeps cross in their middles",
            ),
            (
                margin >= limits.least_margin,
                MismatchError,
                "one way of laying the sweeps together, got another that fits almost as well (log likelihood "
                f"{margin:.0f} less); sweep where vessels or edges tell places apart",
            ),
            (
                moved <= _FOLLOWED * blur,
                InsufficientDataError,
                f"tissue that stayed within {_FOLLOWED * blur:.2f} mm rms between sweeps, got "
                "some that moved by "
                f"{moved:.2f} mm rms where they cross; sweep again with less pressure, more gel "
                "and the breath held",
            ),
            (
                sigma <= limits.largest_sigma,
                InsufficientDataError,
                f"parts of the tissue to agree on the length to {100 * limits.largest_sigma:.1f} %, got "
                f"{100 * sigma:.1f} %, with {moved:.2f} mm rms of movement between the sweeps; "
                "sweep again over more "
                "texture, with less pressure",
            ),
        )
        for holds, error, words in requirements:
            if not holds:
                raise error(f"{self.given[0].name} and {self.given[1].name}: expected {words}")
        scaled = [self._scaled(k, mirrored[k], end, whole, moved) for k in (0, 1)]
        to_world = [
            s.poses[0]
            * (self.sweeps[k][mirrored[k]].corrected(end.placing.bends[k])[0] * self._back(k)).inv()
            for k, s in enumerate(scaled)
        ]
        details: dict[str, float | str] = {
            "similarity": end.correlation,
            "overlap_mm": overlap,
            "angle_deg": angle,
            "margin": margin,
            "tissue_moved_mm": moved,
        }
        return CrossedPair(
            scaled[0],
            scaled[1],
            to_world[0] * end.placing.first_from_second * to_world[1].inv(),
            end.placing.bends[:, :3].copy(),
            joint,
            end.correlation,
            overlap,
            angle,
            mirrored,
            (self.given[0].frame_time_s, self.given[1].frame_time_s),
            details,
        )

    def moved_mm(self, end: Refined, mirrored: tuple[bool, bool]) -> tuple[float, float]:
        """How far tissue moved between the sweeps, and the blur at which that was seen."""
        blur = self.settings.blurs_mm[max(0, len(self.settings.blurs_mm) - 2)]
        there = refined(self.at(blur, mirrored), end.placing, self.prior, self.independent(blur), 0)
        return rms_mm(Parts.of(there)), blur

    def _back(self, which: int) -> RigidTransform:
        return RigidTransform.from_translation(-self.given[which].centre_mm)

    def _scaled(
        self, which: int, flipped: bool, end: Refined, whole: FloatArray, moved_mm: float
    ) -> ScaledPoses:
        given, straight = self.given[which], self.sweeps[which][flipped]
        bends = end.placing.bends[which]
        path_from_image = straight.corrected(bends) * self._back(which)
        if given.sensed is None:
            poses = path_from_image[0].inv() * path_from_image
        else:
            # The correction's mean turn is the sensor's to tell.
            world = (given.sensed * path_from_image.rotation.inv()).mean()
            poses = RigidTransform.from_rotation(world) * path_from_image
            poses = RigidTransform.from_translation(-poses.translation[0]) * poses
        terms, ours = terms_of(straight.path, which), bend_slice(which)
        values = np.array([float(terms[0, ours] @ bends), bends[3], bends[5]])
        own = terms @ whole @ terms.T
        # Both sweeps' bends come first among the prior's parameters.
        bends_of = slice(which * len(BENDS), (which + 1) * len(BENDS))
        before = np.linalg.inv(self.prior.information)[bends_of, bends_of]
        prior = terms[:, ours] @ before @ terms[:, ours].T
        information = _positive(np.linalg.inv(own) - np.linalg.inv(prior))
        evidence = ScaleEvidence(
            "crossing", np.linalg.pinv(information) @ (np.linalg.inv(own) @ values), information
        )
        return ScaledPoses(
            poses,
            _pose_covariance(straight, bends, whole[ours, ours], path_from_image),
            float(values[0]),
            float(np.sqrt(own[0, 0])),
            (evidence,),
            {"similarity": end.correlation, "tissue_moved_mm": moved_mm},
        )


def _bend_covariance(
    first: CrossingSweep,
    second: CrossingSweep,
    sweeps: Sequence[Sequence[StraightSweep]],
    settings: CrossingSettings,
) -> FloatArray:
    """Covariance of both sweeps' bends before looking, shape (14, 14)."""
    found = np.zeros((14, 14))
    for k, each in enumerate((first, second)):
        at = k * len(BENDS)
        found[range(at, at + 3), range(at, at + 3)] = settings.tissue_sigma**2
        tilt, yaw = np.minimum(each.turn_sigma_per_mm, slow_error_per_mm(each, sweeps[k][0].path.length_mm))
        for j, rate in ((3, tilt), (4, tilt), (5, yaw), (6, yaw)):
            found[at + j, at + j] = rate**2
    # Probe and curves are the same: so is the error of the scale.
    shared = first.scale_sigma * second.scale_sigma
    found[np.ix_([0, len(BENDS)], [0, len(BENDS)])] += shared
    return found


def _pose_covariance(
    straight: StraightSweep, bends: FloatArray, own: FloatArray, poses: RigidTransform
) -> FloatArray:
    """Covariance of every frame's pose about its centre, along the first frame's axes, (n, 6, 6)."""
    twists = straight.path.twists(bends, straight.path.bent(bends))
    near = np.clip(np.searchsorted(straight.path.travel_mm, straight.frame_travel_mm), 0, len(twists) - 1)
    moved = twists[near] - twists[near[:1]]
    centres = straight.corrected(bends).translation
    shift = moved[:, :3] + np.cross(moved[:, 3:], centres[:, :, None], axis=1)
    axes = poses[0].rotation.as_matrix()
    rows = np.concatenate([np.einsum("ji,njk->nik", axes, part) for part in (shift, moved[:, 3:])], axis=1)
    return np.asarray(rows @ own @ rows.transpose(0, 2, 1))


def _positive(matrix: FloatArray) -> FloatArray:
    """The nearest matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
