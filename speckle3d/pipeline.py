"""The stages in order, streaming: RF sweep in, poses of every frame out.

RF -> intensity -> in-plane motion -> patch correlation -> |distance| and sigma -> plane per frame pair
(orientation-consistent subset) -> graph of relative poses -> trajectory -> drift correction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.doubts import Doubt, unrefuted
from speckle3d.core.errors import InsufficientDataError, naming
from speckle3d.core.expected import require_kind
from speckle3d.core.geometry import mirrored
from speckle3d.core.handover.plots import plot_poses
from speckle3d.core.handover.tables import poses_array, poses_table
from speckle3d.core.progress import Progress
from speckle3d.core.reconstruction import FramePairs, SharedErrors
from speckle3d.core.relative import MIRROR, RelativePoses
from speckle3d.core.shown import shown
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.examine.curves import examine_curves
from speckle3d.examine.disagreements import disagreements
from speckle3d.examine.images import examine_path, examine_standing, interleaved
from speckle3d.examine.recording import examine_recording
from speckle3d.examine.sensors import examined_sensors
from speckle3d.matching.chosen import match_again
from speckle3d.matching.frames import ImageSink, MatchedSweep, StageTimes, match_sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.quality import FrameFlag, describe, flag_frames, sound_pairs
from speckle3d.matching.spectra import row_spectra
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import SpeckleSizes
from speckle3d.motion.attenuation import Attenuation, estimate_attenuation
from speckle3d.motion.coherence import Coherence, RowScales, scale_sigma
from speckle3d.motion.direction import sensed_orientation, settle_direction
from speckle3d.motion.estimate import Motion, MotionProblem, edges_of, estimate_motion, frame_pairs
from speckle3d.motion.revisits import find_returns, tie_returns
from speckle3d.motion.signs import SignedPairs
from speckle3d.motion.subset import consistent_planes
from speckle3d.motion.trajectory import solve_trajectory, unjoined
from speckle3d.motion.uncertainty import SlopeEvidence, claimed_covariance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PairSink = Callable[[FramePairs], None]
"""Called with some pairs at a time, in the order of their second frames, once the signs are settled."""
MOTION = "distances, planes and scale"
"""Name of the stage in `StageTimes`."""
MOST_LOST = 0.3
"""Share of frames that may not be placed; with more, lengths are mostly guesses."""


@shown
@dataclass(frozen=True)
class Tracked:
    """What the image-based stages found.

    Attributes
    ----------
    image : RigidTransform, length n
        Poses from all patches.
    covariance : ndarray, shape (n, 6, 6)
        Of `image`; see `speckle3d.motion.uncertainty`. What the curves' mismatch does is in it.
    subset : RigidTransform, length n, or None
        Poses from the orientation-consistent patches.
    rejected_share : float
        Share of measured patches outside the consistent subset; NaN without one.
    flags : ndarray of int, shape (n,)
        `FrameFlag` of every frame; zero for those to be trusted.
    edges : RelativePoses
        The frame pairs that the trajectory was solved from, in the sense of motion of `image`; their
        covariances are those of pairs independent of each other.
    scale_sigma : float
        Relative standard deviation of the scale of distances, which all pairs share: that of the images' own
        adaptation and `curves_sigma`, the root of the sum of squares.
    curves_sigma : float
        The part of it that is the curves' mismatch with this probe and tissue.
    direction : int
        Sign of the elevational motion, +1 or -1.
    direction_from : str
        What settled the sign.
    attenuation : Attenuation
        Of the tissue over the curves' phantom, by the echoes' spectrum.
    coherence : Coherence or None
        How the patches' echoes depart from a phantom's; None if not adapted to.
    curves : DecorrelationCurves
        With which the images were read.
    rows : RowScales or None
        Scales that rows of patches ask for, over that of all; None if not adapted to.
    slopes : SlopeEvidence
        What the images' own yaw and tilt are worth.
    times : StageTimes
        Seconds spent in each stage.
    doubts : tuple of Doubt
        What of the recording contradicts the images or itself; what rests on refuted parts was not used.
    grid : ImageGrid or None
        Of the sweep.
    frame_time_s : ndarray, shape (n,), or None
        Of the sweep.
    """

    image: RigidTransform
    covariance: FloatArray
    subset: RigidTransform | None
    rejected_share: float
    flags: IntArray
    edges: RelativePoses
    scale_sigma: float
    curves_sigma: float
    direction: int
    direction_from: str
    attenuation: Attenuation
    coherence: Coherence | None
    curves: DecorrelationCurves
    rows: RowScales | None
    slopes: SlopeEvidence
    times: StageTimes
    doubts: tuple[Doubt, ...] = ()
    grid: ImageGrid | None = None
    frame_time_s: FloatArray | None = None

    @property
    def shared(self) -> SharedErrors:
        """What `covariance` has all frames have wrong together."""
        scale = scale_sigma(self.coherence)
        return SharedErrors(scale, self.curves_sigma, self.slopes.deviation_per_mm)

    def plot(self) -> Figure:
        """Draw length, tilt, yaw and roll against the frame, with their 95 % intervals."""
        poses = {"image": self.image}
        if self.subset is not None:
            poses["consistent-subset"] = self.subset
        return plot_poses(poses, self._centre_mm, self.covariance)

    def to_dataframe(self) -> Any:
        """Poses in mode `image` as a `pandas.DataFrame`, a row for each frame; see `poses_table`."""
        return poses_table(self.image, self._centre_mm, self.frame_time_s, self.covariance, self.flags)

    def to_xarray(self) -> Any:
        """Poses in mode `image` as an `xarray.DataArray` of rigid matrices, mm."""
        return poses_array(self.image, self.frame_time_s)

    @property
    def _centre_mm(self) -> FloatArray:
        return np.zeros(3) if self.grid is None else self.grid.centre_mm

    def facts(self) -> list[tuple[str, object]]:
        """What the tracked sweep shows of itself."""
        z = self.image.translation[:, 2]
        flagged = int(np.count_nonzero(self.flags))
        subset = "none" if self.subset is None else f"{1 - self.rejected_share:.0%} of patches agree"
        return [
            ("frames", f"{len(self.image)}, {flagged} of them flagged"),
            ("travel", f"{np.abs(np.diff(z)).sum():.2f} mm along the image's normal, in mode image"),
            ("length error", f"{100 * self.scale_sigma:.1f} % claimed (standard deviation)"),
            ("direction", f"{self.direction:+d}, from {self.direction_from}"),
            ("subset", subset),
            ("pairs", f"{self.pairs} of frames"),
            (
                "doubts",
                "; ".join(f"{each.about}: {each.suspect or each.evidence}" for each in self.doubts) or "none",
            ),
        ]

    @property
    def pairs(self) -> int:
        """Frame pairs that the trajectory was solved from."""
        return len(self.edges)


def track(
    sweep: Sweep,
    curves: DecorrelationCurves,
    config: Config | None = None,
    progress: Progress | None = None,
    sink: PairSink | None = None,
    images: ImageSink | None = None,
) -> Tracked:
    """Estimate the pose of every frame from the images, and from the orientation-consistent patches.

    The second set of poses, `Tracked.subset`, needs an orientation sensor calibrated to the image that has
    readings for all frames.

    Parameters
    ----------
    sweep : Sweep
        n frames, read one at a time.
    curves : DecorrelationCurves
        Of the sweep's probe and settings.
    config : Config, optional
    progress : callable, optional
        Called with frames done and frames in all; `speckle3d.progress_bar` makes one.
    sink : callable, optional
        Called with the frame pairs, some at a time.
    images : callable, optional
        Called with every intensity image.

    Returns
    -------
    Tracked

    Raises
    ------
    MismatchError
        If the curves belong to another probe, frequency, sampling, patch size or depth, by what the files say
        or by what the images do; see `speckle3d.examine`.
    InsufficientDataError
        If too many frames have no speckle in common with others, if the images do not determine the length,
        or if they cannot be those of one probe that moves (`speckle3d.examine.images`).

    Examples
    --------
    >>> import speckle3d as s3
    >>> sweep = s3.load_sweep("data/phantom.h5").part(0, 32)
    >>> tracked = s3.track(sweep, s3.load_curves("data/curves.h5"))
    >>> len(tracked.image), tracked.direction_from, bool(tracked.flags.any())
    (32, 'tracker', False)
    """
    require_kind(sweep, Sweep, "sweep", "load_sweep(path)")
    require_kind(curves, DecorrelationCurves, "curves", "load_curves(path)")
    if len(sweep) < 2:
        raise InsufficientDataError(f"{sweep.name}: expected at least 2 frames, got {len(sweep)}")
    settings, times = config or Config(), StageTimes()
    matcher = matcher_for(sweep, curves, settings)
    doubts = examine_recording(sweep, matcher, curves)

    sizes = SpeckleSizes(sweep, matcher, images)
    matches = match_sweep(sweep, matcher, settings.trajectory, settings.quality, times, progress, sizes.keep)
    table, flags = matches.table, frame_flags(sweep, matches, settings)

    with times.of(MOTION):
        attenuation = estimate_attenuation(curves, row_spectra(sweep, matcher, np.flatnonzero(flags == 0)))
        problem = motion_problem(attenuation.applied(curves), matcher, len(sweep), settings)
        motion = estimate_motion(problem, table, sound_pairs(table, flags))
    doubts += attenuation.doubts
    flags = with_unplaced(sweep, flags, motion.pairs)
    with times.of("checks of the images"):
        doubts += examine_standing(sweep, matcher, curves, motion.path[:, 0], flags == 0)
        doubts += examine_curves(sweep, matcher, sizes, motion, flags == 0)

    with times.of("revisits"):
        table, motion = tied_to_returns(sweep, matcher, table, motion, flags)
    with times.of("trajectory"):
        slopes = motion.slopes
        mismatch = motion.problem.curves.mismatch(settings.curves.same_probe, attenuation.log_length_sigma)
        edges = edges_of(table, motion.pairs, slopes.applied(motion.pairs.planes))
        trajectory = solve_trajectory(edges, len(sweep), matcher.centre_mm, settings.trajectory, True)
        shared = SharedErrors(scale_sigma(motion.coherence), mismatch, slopes.deviation_per_mm)
        covariance = claimed_covariance(
            trajectory.poses, trajectory.covariance, matcher.centre_mm, shared, motion.structure
        )
    doubts += examine_path(
        sweep,
        trajectory.poses,
        covariance,
        matches.table,
        motion.pairs,
        problem.patches.centre_mm,
        float(curves.distance_mm[-1]),
        flags == 0,
    )

    with times.of("sensors"):
        sensors = examined_sensors(sweep, trajectory.poses, settings.sensors.examine)
        direction, source = settle_direction(
            sensors.trusted, trajectory.poses, settings.sensors, sensors.turn_confirmed
        )
        subset, used = consistent_poses(sensors.trusted, table, motion, direction, settings)

    sigma = float(np.hypot(scale_sigma(motion.coherence), mismatch))
    if sink:
        for some in frame_pairs(motion, table, edges, used, direction, sigma):
            sink(some)
    image = _seen_from(direction, trajectory.poses)
    covariance = covariance if direction > 0 else MIRROR @ covariance @ MIRROR
    return Tracked(
        image=image,
        covariance=covariance,
        subset=None if subset is None else _seen_from(direction, subset),
        rejected_share=float("nan") if subset is None else _rejected_share(motion.pairs, used),
        flags=flags,
        edges=edges if direction > 0 else edges.mirrored(),
        scale_sigma=sigma,
        curves_sigma=mismatch,
        direction=direction,
        direction_from=source,
        attenuation=attenuation,
        coherence=motion.coherence,
        curves=motion.problem.curves,
        rows=motion.rows,
        slopes=slopes,
        times=times,
        doubts=(*doubts, *sensors.doubts, *disagreements(sensors.trusted, image, covariance, sigma)),
        grid=sweep.grid,
        frame_time_s=sweep.frame_time_s,
    )


def matcher_for(sweep: Sweep, curves: DecorrelationCurves, config: Config) -> FrameMatcher:
    """Make the matcher of a sweep's frames, none of which is read.

    Raises
    ------
    MismatchError
        If the curves belong to another probe, frequency, sampling, patch size or depth.
    """
    matcher = FrameMatcher(sweep, config.intensity, config.patches, config.inplane, config.matching)
    curves.key.require_same(matcher.key)
    with naming(sweep.name):
        matcher.keep_depths(curves.depth_mm)
    return matcher


def motion_problem(
    curves: DecorrelationCurves, matcher: FrameMatcher, frames: int, config: Config
) -> MotionProblem:
    """Gather what correlations are read with."""
    planes, trajectory, adapt = config.planes, config.trajectory, config.coherence.adapt
    return MotionProblem(curves, matcher.patches, matcher.centre_mm, frames, planes, trajectory, adapt)


def frame_flags(sweep: Sweep, matches: MatchedSweep, config: Config) -> IntArray:
    """Flags of all frames, if few enough have one."""
    least = config.trajectory.least_correlation
    flags = flag_frames(matches.features, config.quality)
    flags[matches.table.unmatched(len(sweep), least)] |= FrameFlag.UNMATCHED
    _require_placed(sweep, flags)
    unrefuted([interleaved(matches.table, len(sweep), least)], sweep.name, InsufficientDataError)
    return flags


def with_unplaced(sweep: Sweep, flags: IntArray, pairs: SignedPairs) -> IntArray:
    """Flags in which sound frames that no pair joins to earlier ones are unmatched, too."""
    flags = np.where(unjoined(pairs.second, len(sweep)) & (flags == 0), int(FrameFlag.UNMATCHED), flags)
    _require_placed(sweep, flags)
    return flags


def _require_placed(sweep: Sweep, flags: IntArray) -> None:
    """Raise if too many frames have a flag."""
    lost = int((flags != 0).sum())
    if lost > MOST_LOST * len(sweep):
        raise InsufficientDataError(
            f"{sweep.name}: expected frames with speckle in common, got {lost} of {len(sweep)} that cannot "
            f"be placed: {'; '.join(describe(flags))}"
        )


def tied_to_returns(
    sweep: Sweep, matcher: FrameMatcher, table: CorrelationTable, motion: Motion, flags: IntArray
) -> tuple[CorrelationTable, Motion]:
    """Match frames of different visits of the same tissue, which the path shows, and add their pairs."""
    returns = find_returns(motion.path[:, 0], motion.problem.trajectory.revisit_mm)
    wanted = [pair for each in returns for pair in each.pairs()]
    table = table.followed_by(match_again(sweep, matcher, wanted))
    ties = tie_returns(returns, motion, table)
    ties = ties[(flags[ties.first] == 0) & (flags[ties.second] == 0)]
    return table, replace(motion, pairs=motion.pairs.and_also(ties))


def consistent_poses(
    sweep: Sweep, table: CorrelationTable, motion: Motion, direction: int, config: Config
) -> tuple[RigidTransform | None, BoolArray]:
    """Poses from the orientation-consistent patches (None without a sensor), and each pair's patches used."""
    sensed = sensed_orientation(sweep, config.sensors)
    if sensed is None:
        return None, motion.pairs.planes.used
    planes = consistent_planes(motion, table, sensed, direction)
    edges = edges_of(table, motion.pairs, planes)
    poses = solve_trajectory(edges, len(sweep), motion.problem.centre_mm, config.trajectory).poses
    return poses, planes.used


def _rejected_share(pairs: SignedPairs, used: BoolArray) -> float:
    return float((pairs.planes.used & ~used).sum() / pairs.planes.used.sum())


def _seen_from(direction: int, poses: RigidTransform) -> RigidTransform:
    return poses if direction > 0 else mirrored(poses)
