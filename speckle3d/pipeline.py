"""The stages in order, streaming: RF sweep in, poses of every frame out.

RF -> intensity -> in-plane motion -> patch correlation -> |distance| and sigma -> plane per frame pair
(orientation-consistent subset) -> graph of relative poses -> trajectory -> drift correction.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.progress import Progress
from speckle3d.core.reconstruction import FramePairs
from speckle3d.core.sweep import Sweep
from speckle3d.examine.curves import examine_key
from speckle3d.examine.disagreements import disagreements
from speckle3d.examine.frames import placed_flags
from speckle3d.examine.images import examine_echoes, examine_images, examine_processing
from speckle3d.examine.sensors import examine_sensors
from speckle3d.matching.frames import ImageSink, match_sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.schedule import PairSchedule
from speckle3d.motion.estimate import estimate_motion, frame_pairs
from speckle3d.motion.planes import MotionProblem
from speckle3d.motion.sensors import consistent_poses, settle_direction
from speckle3d.motion.tissue import averaging_loss, grey_error, tissue_curves
from speckle3d.motion.trajectory import loose_frames
from speckle3d.tracked import Tracked

PairSink = Callable[[FramePairs], None]
"""Called with the frame pairs, in the order of their second frames, once the signs are settled."""


def track(
    sweep: Sweep,
    curves: DecorrelationCurves,
    config: Config | None = None,
    progress: Progress | None = None,
    sink: PairSink | None = None,
    images: ImageSink | None = None,
) -> Tracked:
    """Estimate the pose of every frame; `speckle3d.tracking.track` says from what, and what is raised."""
    settings = config or Config()
    if len(sweep) < 2:
        raise InsufficientDataError(f"expected at least 2 frames, got {len(sweep)}")
    matcher = FrameMatcher(sweep, settings, curves)
    doubts = examine_key(curves, matcher.laid, matcher.patches)
    matches = match_sweep(sweep, matcher, PairSchedule(settings.trajectory), progress, images)
    doubts += examine_echoes(matches)
    placed_flags(matches.flags)

    tissue = tissue_curves(curves, matches.texture)
    problem = MotionProblem(
        tissue.curves,
        matcher.patches,
        matcher.centre_mm,
        len(sweep),
        settings.planes,
        settings.trajectory,
        matches.repeats,
    )
    motion = estimate_motion(problem, matches.table.where(matches.sound))
    flags = placed_flags(matches.flags, loose_frames(motion.pairs.second, matches.flags.size))

    credible, sensor_doubts = examine_sensors(sweep, motion.poses, settings.sensors.examine)
    direction, source = settle_direction(credible, motion.poses, settings.sensors, sensor_doubts)
    motion = motion.mirrored() if direction < 0 else motion
    subset = consistent_poses(motion, credible, settings.sensors)

    mismatch = motion.problem.curves.mismatch(settings.curves.same_probe, tissue.attenuation.log_length_sigma)
    averaging = averaging_loss(matches.table.where(matches.sound), matches.features)
    grey = grey_error(matcher.signal, matches.texture) if curves.origin == "data sheet" else 0.0
    error = float(np.linalg.norm([mismatch, averaging, grey]))
    shared, covariance = motion.claims(float(np.hypot(error, tissue.structure)))

    doubts += tissue.attenuation.doubts + examine_processing(
        float(np.hypot(tissue.structure, grey)), averaging
    )
    # What structure leaves open is told by itself.
    doubts += examine_images(matches, motion, motion.claims(error)[1], tissue.unattenuated, flags == 0)
    doubts += sensor_doubts + disagreements(credible, motion.poses, covariance, settings.fused)
    if sink:
        sink(frame_pairs(motion, subset.used, shared.length_sigma))
    return Tracked(
        image=motion.poses,
        covariance=covariance,
        subset=subset.poses,
        rejected_share=subset.rejected_share,
        flags=flags,
        edges=motion.edges,
        direction=direction,
        direction_from=source,
        attenuation=tissue.attenuation,
        coherence=motion.coherence,
        curves=motion.problem.curves,
        shared=shared,
        doubts=doubts,
        grid=sweep.grid,
        frame_time_s=sweep.frame_time_s,
    )
