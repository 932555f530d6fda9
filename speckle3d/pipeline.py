"""The stages in order, streaming: RF sweep in, poses of every frame out.

RF -> intensity -> in-plane motion -> patch correlation -> |distance| and sigma -> plane per frame pair
(orientation-consistent subset) -> graph of relative poses -> trajectory -> drift correction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, naming
from speckle3d.core.sweep import Sweep
from speckle3d.correction.drift import DriftCorrection, correct_orientation, correct_pose
from speckle3d.matching.blocks import (
    Block,
    ImageSink,
    MatchedBlock,
    MatchedFrame,
    StageTimes,
    blocks_of,
    match_block,
)
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.motion.decorrelation import fit_curves
from speckle3d.motion.direction import orientation_at, orientation_sensor
from speckle3d.motion.distances import DistanceEstimator
from speckle3d.motion.estimate import PairSink, Solution, Tracked
from speckle3d.motion.path import Walk
from speckle3d.motion.phantom import phantom_samples

Progress = Callable[[int, int], None]
"""Called with frames done and frames in all."""
BlockSource = Callable[[Block], MatchedBlock | None]
"""Gives a block that has been matched already, None for one that has not."""


def track(
    sweep: Sweep,
    curves: DecorrelationCurves,
    config: Config | None = None,
    progress: Progress | None = None,
    sink: PairSink | None = None,
    images: ImageSink | None = None,
    matched: BlockSource | None = None,
) -> Tracked:
    """Estimate the pose of every frame from the images, and from the orientation-consistent patches if asked.

    Parameters
    ----------
    images : callable, optional
        Not called with frames of blocks that `matched` gives.
    matched : callable, optional
        Asked for each block of frames before it is matched here.

    Raises
    ------
    MismatchError
        If the curves belong to another probe, frequency, sampling or patch size.
    InsufficientDataError
        If frames have no speckle in common.
    """
    settings = config or Config()
    matcher = _matcher_for(sweep, curves, settings)
    walk = Walk(sweep, matcher, DistanceEstimator(curves, matcher.patches), settings)
    for each in _matched(walk, images, matched):
        walk.place(each)
        if progress:
            progress(each.frame + 1, len(sweep))
    return Solution(walk, curves).solve(sink)


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
    frames = list(match_block(sweep, matcher, settings, block, images, times))
    return MatchedBlock(frames, times.seconds)


def _matcher_for(sweep: Sweep, curves: DecorrelationCurves, config: Config) -> FrameMatcher:
    if len(sweep) < 2:
        raise InsufficientDataError(f"{sweep.name}: expected at least 2 frames, got {len(sweep)}")
    matcher = FrameMatcher(sweep, config.intensity, config.patches, config.inplane, config.matching)
    curves.key.require_same(matcher.key)
    return matcher


def _matched(walk: Walk, images: ImageSink | None, given: BlockSource | None) -> Iterator[MatchedFrame]:
    """All frames of a sweep in order, from blocks that are there and those that are matched now."""
    for block in blocks_of(len(walk.sweep), walk.config.trajectory.block_frames):
        held = None if given is None else given(block)
        if held is not None:
            walk.times.include(held.seconds)
            yield from held.frames
        else:
            yield from match_block(walk.sweep, walk.matcher, walk.config, block, images, walk.times)


def calibrate_curves(
    sweeps: Sequence[Sweep], config: Config | None = None, progress: Progress | None = None
) -> DecorrelationCurves:
    """Measure decorrelation curves on phantom sweeps whose positions are known.

    Raises
    ------
    InsufficientDataError
        If positions are not known, or the distances do not span the curves.
    MismatchError
        If the sweeps differ in probe, frequency or sampling.
    """
    settings = config or Config()
    if not sweeps:
        raise InsufficientDataError("expected at least one phantom sweep, got none")
    samples, keys = [], []
    total, before = sum(len(sweep) for sweep in sweeps), 0
    for sweep in sweeps:
        matcher = FrameMatcher(
            sweep, settings.intensity, settings.patches, settings.inplane, settings.matching
        )
        keys.append(matcher.key)
        keys[0].require_same(matcher.key, "the phantom sweeps do not match each other")
        samples.append(phantom_samples(sweep, matcher, settings.curves, _shifted(progress, before, total)))
        before += len(sweep)
    return fit_curves(keys[0], samples, settings.curves)


def _shifted(progress: Progress | None, before: int, total: int) -> Progress | None:
    return None if progress is None else lambda done, _: progress(before + done, total)


def require_modes(sweep: Sweep, modes: Sequence[str]) -> None:
    """Check that the sweep has what every drift mode needs, before any work is done.

    Raises
    ------
    InvalidInputError
        If a mode is unknown.
    InsufficientDataError
        If its sensor is missing, not calibrated to the image, or covers no frame.
    """
    sensors = {
        "pose": (sweep.tracker, "a tracker in /tracker", "sensor_from_image"),
        "orientation": (
            orientation_sensor(sweep),
            "an orientation sensor in /orientation",
            "sensor_from_image_wxyz" if sweep.orientation else "sensor_from_image",
        ),
    }
    for mode in modes:
        if mode not in sensors:
            raise InvalidInputError(f"expected a drift mode among orientation, pose; got {mode!r}")
        sensor, wanted, attribute = sensors[mode]
        where = f"{sweep.name}: drift mode {mode}"
        if sensor is None:
            raise InsufficientDataError(f"{where}: expected {wanted}, got none")
        if sensor.sensor_from_image is None:
            raise InsufficientDataError(
                f"{where}: the sensor is not calibrated to the image: it lacks the attribute {attribute}"
            )
        if not sensor.covers(sweep.frame_time_s).any():
            raise InsufficientDataError(f"{where}: expected readings over the frames, got none")


def correct(
    tracked: Tracked, sweep: Sweep, modes: Sequence[str], config: Config | None = None
) -> dict[str, DriftCorrection]:
    """Correct the drift of the image-based poses in each of `modes`.

    Raises
    ------
    InsufficientDataError
        If a mode's sensor is missing, not calibrated to the image, or covers too little of the sweep.
    """
    settings = config or Config()
    require_modes(sweep, modes)
    done: dict[str, DriftCorrection] = {}
    # Wander that the sensed orientation shows need not be made up for by cubics.
    start = tracked.subset if tracked.subset is not None else tracked.image
    for mode in modes:
        if mode == "pose":
            done[mode] = _correct_by_tracker(start, sweep, settings)
        else:
            done[mode] = _correct_by_orientation(start, sweep, settings)
    return done


def _correct_by_tracker(poses: RigidTransform, sweep: Sweep, config: Config) -> DriftCorrection:
    assert sweep.tracker is not None
    covered = sweep.tracker.covers(sweep.frame_time_s)
    measured = sweep.tracker.world_from_image(sweep.frame_time_s[covered])
    with naming(sweep.name):
        return correct_pose(poses, measured, covered, sweep.grid.corners_mm, config.drift)


def _correct_by_orientation(poses: RigidTransform, sweep: Sweep, config: Config) -> DriftCorrection:
    sensor = orientation_sensor(sweep)
    assert sensor is not None
    covered = sensor.covers(sweep.frame_time_s)
    rotation = orientation_at(sensor, sweep.frame_time_s[covered])
    with naming(sweep.name):
        return correct_orientation(poses, rotation, covered, sweep.grid.centre_mm, config.drift)
