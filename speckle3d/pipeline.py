"""The stages in order, streaming: RF sweep in, poses of every frame out.

RF -> intensity -> in-plane motion -> patch correlation -> |distance| and sigma -> plane per frame pair
(orientation-consistent subset) -> graph of relative poses -> trajectory -> drift correction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.checks import doubts_of_curves, doubts_of_path, doubts_of_standing
from speckle3d.config import Config
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.doubts import Doubt, unrefuted
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.expected import require_kind
from speckle3d.core.geometry import mirrored
from speckle3d.core.handover.plots import plot_poses
from speckle3d.core.handover.tables import poses_array, poses_table
from speckle3d.core.progress import Progress
from speckle3d.core.reconstruction import FramePairs, SharedErrors
from speckle3d.core.relative import MIRROR, RelativePoses
from speckle3d.core.shown import shown
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.examine.disagreements import disagreements
from speckle3d.examine.sensors import examined_sensors
from speckle3d.matching.blocks import (
    Block,
    BlockSource,
    ImageSink,
    MatchedBlock,
    MatchedSweep,
    StageTimes,
    match_block,
    match_sweep,
)
from speckle3d.matching.chosen import match_again
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.quality import FrameFlag, describe, flag_frames
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import SpeckleSizes, doubt_images
from speckle3d.motion.coherence import Coherence, scale_sigma
from speckle3d.motion.curve_doubts import doubt_depths
from speckle3d.motion.curve_prior import RowsSeen
from speckle3d.motion.direction import sensed_orientation, settle_direction
from speckle3d.motion.estimate import PairReader
from speckle3d.motion.plausibility import interleaved
from speckle3d.motion.revisits import find_returns, tie_returns
from speckle3d.motion.signs import SignedPairs
from speckle3d.motion.uncertainty import SlopeEvidence, pose_covariance, with_common_scale
from speckle3d.stages import PLANES, matcher_for, measured, rows_of, sound_pairs, straightened_by

if TYPE_CHECKING:
    from matplotlib.figure import Figure

"""Called with frames done and frames in all."""
PairSink = Callable[[FramePairs], None]
"""Called with some pairs at a time, in the order of their second frames, once the signs are settled."""
MOST_LOST = 0.3
"""Share of frames that may not be placed; with more, lengths are mostly guesses."""
STRAIGHTENING = "curves"
"""Name of a stage in `StageTimes`."""


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
    coherence : Coherence or None
        How the patches' echoes depart from a phantom's; None if not adapted to.
    curves : DecorrelationCurves
        With which the images were read: those given, straightened by what depths disagree on.
    rows : RowsSeen
        Distances that rows of patches still want, over those of all.
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
    coherence: Coherence | None
    curves: DecorrelationCurves
    rows: RowsSeen
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
    matched: BlockSource | None = None,
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
        Called with every intensity image, but not with those of blocks that `matched` returns.
    matched : callable, optional
        Asked for each block of frames before it is matched here.

    Returns
    -------
    Tracked

    Raises
    ------
    MismatchError
        If the curves belong to another probe, frequency, sampling, patch size or depth, by what the files say
        or by what the images do; see `speckle3d.motion.curve_doubts`.
    InsufficientDataError
        If too many frames have no speckle in common with others, if the images do not determine the length,
        or if they cannot be those of one probe that moves (`speckle3d.motion.plausibility`).

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
    settings, times = config or Config(), StageTimes()
    matcher = _matcher_for(sweep, curves, settings)
    doubts = unrefuted(
        [*doubt_depths(curves, matcher.laid, matcher.patches), *doubt_images(sweep)],
        sweep.name,
        MismatchError,
    )
    reader = PairReader(
        curves, matcher.patches, matcher.centre_mm, len(sweep), settings.planes, settings.trajectory
    )

    # RF -> intensity -> in-plane motion -> patch correlation
    sizes = SpeckleSizes(sweep, matcher, images)
    found = match_sweep(
        sweep, matcher, settings.trajectory, settings.quality, times, progress, sizes.keep, matched
    )
    flags = _flagged(sweep, found, settings)

    # -> |distance| and its sigma -> plane per frame pair, with its sign
    pairs, coherence, path = measured(found.table, flags, reader, settings, times)
    with times.of("checks of the images"):
        sound = sound_pairs(found.table, flags)
        flags = _with_unjoined(flags, reader, pairs)
        _require_placed(sweep, flags)
        # What stands still would be blamed on the curves.
        doubts += doubts_of_standing(sweep, matcher, curves, path, flags)
        factors = reader.depth_factors(found.table, path, sound, settings.coherence)
        doubts += doubts_of_curves(
            sweep, curves, matcher, sizes, reader, factors, flags, pairs, coherence, path
        )

    # -> curves of the lens that the depths of the images agree on, and everything read with them
    given = curves
    with times.of(STRAIGHTENING):
        curves, mismatch = straightened_by(factors, curves, coherence, matcher.patches, settings)
    if curves is not given:
        reader = reader.with_curves(curves)
        pairs, coherence, path = measured(found.table, flags, reader, settings, times, path)
        with times.of(STRAIGHTENING):
            factors = reader.depth_factors(found.table, path, sound, settings.coherence)

    # -> pairs of frames from different visits of the same tissue, which the path shows
    with times.of("revisits"):
        returns = find_returns(path[:, 0], settings.trajectory.revisit_mm)
        wanted = [pair for each in returns for pair in each.pairs()]
        table = found.table.followed_by(match_again(sweep, matcher, wanted))
        ties = tie_returns(
            returns, table, path[:, 0], reader.fitter, coherence, settings.trajectory.least_correlation
        )
        pairs = pairs.and_also(ties[(flags[ties.first] == 0) & (flags[ties.second] == 0)])

    # -> graph of relative poses -> trajectory
    with times.of("trajectory"):
        slopes = reader.slopes(pairs, coherence)
        edges = reader.edges(table, pairs, slopes.applied(pairs.planes))
        trajectory = reader.solve(edges, with_covariance=True)
        covariance = pose_covariance(
            trajectory.poses,
            trajectory.covariance,
            matcher.centre_mm,
            scale_sigma(coherence),
            slopes,
            0.0 if coherence is None else float(coherence.share.mean()),
        )
        doubts += doubts_of_path(
            sweep, trajectory.poses, covariance, found.table, pairs, matcher, curves, flags
        )

    # Checks ask what contradicts images and curves as given: a mismatch shows in them and excuses nothing.
    # Claimed errors include it.
    whole = with_common_scale(covariance, trajectory.poses, matcher.centre_mm, mismatch)
    sigma = float(np.hypot(scale_sigma(coherence), mismatch))

    # -> sensors that do not contradict themselves -> sign of the motion
    with times.of("sensors"):
        sensors = examined_sensors(sweep, trajectory.poses, settings.sensors.examine)
        direction, source = settle_direction(
            sensors.trusted, trajectory.poses, settings.sensors, sensors.turn_confirmed
        )

    # -> orientation-consistent subset -> its own trajectory
    with times.of(PLANES):
        subset, used = _consistent(sensors.trusted, table, pairs, direction, reader, settings)

    if sink:
        for rows in reader.rows(table, pairs, edges, used, direction, sigma):
            sink(rows)
    image, whole = (
        _seen_from(direction, trajectory.poses),
        whole if direction > 0 else MIRROR @ whole @ MIRROR,
    )
    return Tracked(
        image=image,
        covariance=whole,
        subset=None if subset is None else _seen_from(direction, subset),
        rejected_share=float("nan") if subset is None else _rejected_share(pairs, used),
        flags=_with_unjoined(flags, reader, pairs),
        edges=edges if direction > 0 else edges.mirrored(),
        scale_sigma=sigma,
        curves_sigma=mismatch,
        direction=direction,
        direction_from=source,
        coherence=coherence,
        curves=curves,
        rows=rows_of(factors, coherence, matcher.patches),
        slopes=slopes,
        times=times,
        doubts=(*doubts, *sensors.doubts, *disagreements(sensors.trusted, image, whole, sigma)),
        grid=sweep.grid,
        frame_time_s=sweep.frame_time_s,
    )


def match_ahead(
    sweep: Sweep,
    curves: DecorrelationCurves,
    block: Block,
    config: Config | None = None,
    images: ImageSink | None = None,
) -> MatchedBlock:
    """Match one block of a sweep, for `track` to take; any process may do so, and in any order.

    Raises
    ------
    MismatchError, InsufficientDataError
        As `track`, before any work is done: the curves are not used otherwise.
    """
    settings, times = config or Config(), StageTimes()
    matcher = _matcher_for(sweep, curves, settings)
    frames = list(match_block(sweep, matcher, settings.trajectory, settings.quality, block, images, times))
    return MatchedBlock(frames, times.seconds)


def _matcher_for(sweep: Sweep, curves: DecorrelationCurves, config: Config) -> FrameMatcher:
    if len(sweep) < 2:
        raise InsufficientDataError(f"{sweep.name}: expected at least 2 frames, got {len(sweep)}")
    return matcher_for(sweep, curves, config)


def _flagged(sweep: Sweep, found: MatchedSweep, config: Config) -> IntArray:
    """Flags of all frames, if few enough have one."""
    flags = flag_frames(found.features, config.quality)
    flags[found.table.unmatched(len(sweep), config.trajectory.least_correlation)] |= FrameFlag.UNMATCHED
    _require_placed(sweep, flags)
    mixed = interleaved(found.table, len(sweep), config.trajectory.least_correlation)
    unrefuted([mixed], sweep.name, InsufficientDataError)
    return flags


def _require_placed(sweep: Sweep, flags: IntArray) -> None:
    """Raise if too many frames have a flag."""
    lost = int((flags != 0).sum())
    if lost > MOST_LOST * len(sweep):
        raise InsufficientDataError(
            f"{sweep.name}: expected frames with speckle in common, got {lost} of {len(sweep)} that cannot "
            f"be placed: {'; '.join(describe(flags))}"
        )


def _with_unjoined(flags: IntArray, reader: PairReader, pairs: SignedPairs) -> IntArray:
    """Flags in which sound frames that no pair joins to earlier ones are unmatched, too."""
    lone = reader.unjoined(pairs.second)
    return np.where(lone & (flags == 0), int(FrameFlag.UNMATCHED), flags)


def _consistent(
    sweep: Sweep,
    table: CorrelationTable,
    pairs: SignedPairs,
    direction: int,
    reader: PairReader,
    config: Config,
) -> tuple[RigidTransform | None, BoolArray]:
    """Poses from the orientation-consistent patches (None without a sensor), and each pair's patches used."""
    sensed = sensed_orientation(sweep, config.sensors)
    if sensed is None:
        return None, pairs.planes.used
    planes = reader.consistent(table, pairs, sensed, direction)
    return reader.solve(reader.edges(table, pairs, planes)).poses, planes.used


def _rejected_share(pairs: SignedPairs, used: BoolArray) -> float:
    return float((pairs.planes.used & ~used).sum() / pairs.planes.used.sum())


def _seen_from(direction: int, poses: RigidTransform) -> RigidTransform:
    return poses if direction > 0 else mirrored(poses)
