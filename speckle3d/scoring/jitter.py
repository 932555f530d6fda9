"""How much of a length a tracker's jitter alone can be.

The jitter is told from third differences of the tracker's place from frame to frame: a hand is too smooth to
have any at 25 frames/s, white noise of standard deviation s gives them ``sqrt(20) s``.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.leastsquares import robust_sigma

_THIRD_DIFFERENCES = np.sqrt(20.0)
"""Of white noise of unit standard deviation: 1 + 9 + 9 + 1 under the root."""

_CUBIC = 4.0
"""Parameters of a cubic: where it ends, its fit to n samples has 4^2 / n of a sample's variance."""

_FEWEST = 8


def jitter_mm(world_from_image: RigidTransform, centre_mm: FloatArray) -> float:
    """Standard deviation of a tracker's jitter along the image's normal, mm; NaN for fewer than eight frames.

    Parameters
    ----------
    world_from_image : RigidTransform, length n
        By the tracker, at the frames' times.
    centre_mm : ndarray, shape (3,)
        The image's centre.
    """
    if len(world_from_image) < _FEWEST:
        return float("nan")
    place = world_from_image.apply(centre_mm)
    normal = world_from_image.rotation.as_matrix()[:, :, 2].mean(axis=0)
    along = place @ (normal / np.linalg.norm(normal))
    return robust_sigma(np.diff(along, 3)) / float(_THIRD_DIFFERENCES)


def jitter_percent(world_from_image: RigidTransform, centre_mm: FloatArray) -> float:
    """What the jitter alone leaves of error in a length that rests on the tracker, in per cent of it.

    A cubic is fitted to the sweep, as mode `pose` does: its ends have ``4^2 / n`` of a reading's variance.
    """
    place = world_from_image.apply(centre_mm)
    length = float(np.linalg.norm(place - place[0], axis=1).max())
    sigma = jitter_mm(world_from_image, centre_mm) * np.sqrt(2.0 * _CUBIC**2 / len(world_from_image))
    return float(100.0 * sigma / length) if length > 0 else float("nan")
