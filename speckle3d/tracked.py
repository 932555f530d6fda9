"""Result of tracking a sweep: image-based poses with their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import Doubt
from speckle3d.core.grid import ImageGrid
from speckle3d.core.poses import RelativePoses, plot_poses, pose_table
from speckle3d.core.reconstruction import SharedErrors
from speckle3d.core.sweep import Sweep
from speckle3d.core.text import text_rows
from speckle3d.motion.attenuation import Attenuation
from speckle3d.motion.coherence import Coherence

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Tracked:
    """Image-based poses of a sweep with errors, curves, pairs and doubts.

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
    grid : ImageGrid
        Of the sweep.
    frame_time_s : ndarray, shape (n,)
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
    doubts: tuple[Doubt, ...]
    grid: ImageGrid
    frame_time_s: FloatArray

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
        return plot_poses(poses, self.grid.centre_mm, self.covariance)

    def to_dataframe(self) -> Any:
        """Poses in mode `image` as a `pandas.DataFrame`, a row for each frame; see `pose_table`."""
        centre_mm, time_s = self.grid.centre_mm, self.frame_time_s
        return pose_table(self.image, centre_mm, self.covariance, time_s=time_s, flags=self.flags)

    def __repr__(self) -> str:
        z = self.image.translation[:, 2]
        flag_count = int(np.count_nonzero(self.flags))
        doubts = "; ".join(f"{doubt.about}: {doubt.suspect or doubt.evidence}" for doubt in self.doubts)
        rows = [
            ("frames", f"{len(self.image)}, {flag_count} of them flagged", ""),
            ("travel", f"{np.abs(np.diff(z)).sum():.2f} mm along the image's normal, in mode image", ""),
            ("length error", f"{100 * self.scale_sigma:.1f} % claimed (standard deviation)", ""),
            ("direction", f"{self.direction:+d}, from {self.direction_from}", ""),
            ("pairs", f"{len(self.edges)} of frames", ""),
            ("doubts", doubts or "none", ""),
        ]
        return f"Tracked\n{text_rows(rows)}".rstrip()

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the scale of distances, which all pairs share."""
        return self.shared.length_sigma
