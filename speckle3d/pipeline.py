"""The stages in order, streaming: RF sweep in, poses of every frame out.

RF -> intensity -> in-plane motion -> patch correlation -> |distance| and sigma -> plane per frame pair
(orientation-consistent subset) -> graph of relative poses -> trajectory -> drift correction.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, naming
from speckle3d.core.grid import ImageGrid
from speckle3d.core.pose_table import plot_poses, pose_table
from speckle3d.core.progress import Progress
from speckle3d.core.reconstruction import FramePairs, SharedErrors
from speckle3d.core.relative import RelativePoses
from speckle3d.core.shown import shown
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep
from speckle3d.examine.curves import examine_key, unrefuted
from speckle3d.examine.disagreements import disagreements
from speckle3d.examine.images import examine_echoes, examine_images
from speckle3d.examine.processing import processing_doubts, shortening, structure_openness
from speckle3d.examine.sensors import examined_sensors
from speckle3d.io.curves import curves_beside, read_curves, trust_words
from speckle3d.matching.frames import ImageSink, match_sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.quality import FrameFlag, flag_frames, require_placed
from speckle3d.matching.schedule import PairSchedule
from speckle3d.motion.attenuation import Attenuation, estimate_attenuation
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.direction import sensed_orientation, settle_direction
from speckle3d.motion.estimate import Motion, estimate_motion, frame_pairs
from speckle3d.motion.lens import stretched
from speckle3d.motion.planes import MotionProblem
from speckle3d.motion.subset import consistent_poses

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PairSink = Callable[[FramePairs], None]
"""Called with the frame pairs, in the order of their second frames, once the signs are settled."""


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
    direction : int
        Sign of the elevational motion, +1 or -1.
    direction_from : str
        What settled the sign.
    attenuation : Attenuation
        Of the tissue over the curves' phantom, by the echoes' spectrum.
    coherence : Coherence
        How the patches' echoes depart from a phantom's, and the scales that rows of patches ask for.
    curves : DecorrelationCurves
        With which the images were read.
    shared : SharedErrors
        What `covariance` has all frames have wrong together.
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
    direction: int
    direction_from: str
    attenuation: Attenuation
    coherence: Coherence
    curves: DecorrelationCurves
    shared: SharedErrors
    doubts: tuple[Doubt, ...] = ()
    grid: ImageGrid | None = None
    frame_time_s: FloatArray | None = None

    def plot(self, sweep: Sweep | None = None) -> Figure:
        """Draw length, tilt, yaw and roll against the frame, with their 95 % intervals.

        Parameters
        ----------
        sweep : Sweep, optional
            From which it was made: its tracker alone and its truth are drawn, where it has them.
        """
        poses = {"image": self.image}
        if self.subset is not None:
            poses["consistent-subset"] = self.subset
        if sweep is not None:
            tracker, times = sweep.tracker, sweep.frame_time_s
            if tracker is not None and tracker.sensor_from_image is not None and tracker.covers(times).all():
                poses["tracker"] = tracker.world_from_image(times)
            if sweep.truth is not None:
                poses["truth"] = sweep.truth
        return plot_poses(poses, self._centre_mm, self.covariance)

    def to_dataframe(self) -> Any:
        """Poses in mode `image` as a `pandas.DataFrame`, a row for each frame; see `pose_table`."""
        others = {"time_s": self.frame_time_s, "flags": self.flags}
        return pose_table(self.image, self._centre_mm, self.covariance, **others)

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
    def scale_sigma(self) -> float:
        """Relative standard deviation of the scale of distances, which all pairs share."""
        return self.shared.length_sigma

    @property
    def curves_sigma(self) -> float:
        """The part of it that is the curves' mismatch with this probe and tissue."""
        return self.shared.curves_sigma

    @property
    def pairs(self) -> int:
        """Frame pairs that the trajectory was solved from."""
        return len(self.edges)


def track(
    sweep: Sweep,
    curves: DecorrelationCurves | None = None,
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
    curves : DecorrelationCurves, optional
        Of the sweep's probe and settings; by default curves.h5 beside its recording, as the
        commands have it, and a warning says how far to trust them.
    config : Config, optional
    progress : callable, optional
        Called with frames done and frames in all; `speckle3d.progress_bar` makes one.
    sink : callable, optional
        Called with the frame pairs.
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
    settings = config or Config()
    if curves is not None:
        require_kind(curves, DecorrelationCurves, "curves", "load_curves(path)")
    else:
        curves = _curves_beside(sweep, settings.curves.same_probe)
    with naming(sweep.name):
        if len(sweep) < 2:
            raise InsufficientDataError(f"expected at least 2 frames, got {len(sweep)}")
        matcher = FrameMatcher(
            sweep,
            settings.intensity,
            settings.patches,
            settings.inplane,
            settings.matching,
            settings.quality,
            curves,
        )
        doubts = examine_key(curves, matcher.laid, matcher.patches)
        matches = match_sweep(sweep, matcher, PairSchedule(settings.trajectory), progress, images)
        doubts += examine_echoes(matches)
        flags = matches.flags(settings.quality, settings.trajectory.least_correlation)
        require_placed(flags)

        attenuation = estimate_attenuation(curves, matches.texture.spectra(flags == 0))
        structure = 0.0 if curves.of_tissue else structure_openness(matches.texture)
        if structure:
            curves = replace(stretched(curves, np.array(structure)), of_tissue=True)
        read = attenuation.applied(curves), matcher.patches, matcher.centre_mm, len(sweep)
        problem = MotionProblem(*read, settings.planes, settings.trajectory)
        bad = (flags & ~FrameFlag.UNMATCHED) != 0
        motion = estimate_motion(
            problem, matches.table, ~bad[matches.table.first] & ~bad[matches.table.second]
        )
        flags[motion.unplaced & (flags == 0)] = int(FrameFlag.UNMATCHED)
        require_placed(flags)

        sensors = examined_sensors(sweep, motion.poses, settings.sensors.examine)
        direction, source = settle_direction(
            sensors.trusted, motion.poses, settings.sensors, sensors.turn_confirmed
        )
        motion = motion.mirrored() if direction < 0 else motion
        sensed = sensed_orientation(sensors.trusted, settings.sensors)
        subset, used = (None, motion.pairs.used) if sensed is None else consistent_poses(motion, sensed)
        mismatch = motion.problem.curves.mismatch(settings.curves.same_probe, attenuation.log_length_sigma)
        short, compression = (
            shortening(matches),
            _compression_error(sweep, matcher.signal, curves, settings, motion),
        )
        open_sigma = float(np.linalg.norm([mismatch, short, compression]))
        shared, covariance = motion.claims(float(np.hypot(open_sigma, structure)))

        doubts += attenuation.doubts
        doubts += unrefuted(processing_doubts(structure, short), InsufficientDataError)
        # What structure leaves open is told by itself.
        doubts += examine_images(matches, motion, motion.claims(open_sigma)[1], curves, flags == 0)
        doubts += sensors.doubts
        doubts += disagreements(sensors.trusted, motion.poses, covariance)
        if sink:
            sink(frame_pairs(motion, used, shared.length_sigma))
        return Tracked(
            image=motion.poses,
            covariance=covariance,
            subset=subset,
            rejected_share=float("nan") if subset is None else 1.0 - float(used[motion.pairs.used].mean()),
            flags=flags,
            edges=motion.edges,
            direction=direction,
            direction_from=source,
            attenuation=attenuation,
            coherence=motion.coherence,
            curves=motion.problem.curves,
            shared=shared,
            doubts=doubts,
            grid=sweep.grid,
            frame_time_s=sweep.frame_time_s,
        )


def require_kind(value: Any, kind: type, name: str, made_by: str) -> None:
    """Raise unless an argument is of a kind.

    Parameters
    ----------
    value : object
        The argument.
    kind : type
    name : str
        Of the argument.
    made_by : str
        What makes such an object, as ``load_sweep(path)``.

    Raises
    ------
    InvalidInputError
        If it is something else.
    """
    if not isinstance(value, kind):
        got = type(value).__name__
        raise InvalidInputError(f"{name}: expected a {kind.__name__}, as {made_by} gives it, got {got}")


def _compression_error(
    sweep: Sweep,
    signal: RFSettings | BModeSettings,
    curves: DecorrelationCurves,
    config: Config,
    motion: Motion,
) -> float:
    """Relative standard deviation of distances by a dynamic range, that of `signal`, if it is estimated.

    One that is wider by its deviation is tried: what it does to fully developed speckle's correlation, a
    tenth of what comes out, can be calculated, what it does to structure and to black and white cannot.
    Curves measured with images compressed alike have its error in them.
    """
    if not isinstance(signal, BModeSettings) or curves.origin != "data sheet":
        return 0.0
    if not signal.dynamic_range_sigma_db:
        return 0.0
    range_db = signal.dynamic_range_db + signal.dynamic_range_sigma_db
    wider = replace(signal, dynamic_range_db=range_db, dynamic_range_sigma_db=0.0)
    c = config
    matcher = FrameMatcher(
        replace(sweep, signal=wider), c.intensity, c.patches, c.inplane, c.matching, c.quality, curves
    )
    matches = match_sweep(sweep, matcher, PairSchedule(config.trajectory))
    table, bad = matches.table, flag_frames(matches.features, config.quality) != 0
    read = estimate_motion(motion.problem, table, ~bad[table.first] & ~bad[table.second])
    spans = [np.ptp(each.path[:, 0]) for each in (motion, read)]
    return abs(float(np.log(spans[1] / spans[0])))


def _curves_beside(sweep: Sweep, same_probe: bool) -> DecorrelationCurves:
    """Read the curves that lie beside a sweep's recording."""
    if sweep.path is None:
        raise InvalidInputError(f"{sweep.name}: expected curves of its probe (load_curves(path)), got none")
    path = curves_beside(sweep.path)
    curves = read_curves(path)
    warnings.warn(trust_words(path, curves, same_probe), stacklevel=3)
    return curves
