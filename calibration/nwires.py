"""N-wire phantoms: points of the image in the phantom from three dots each, PLUS's error, and labels of dots.

The outer wires of an N are parallel, so that the middle dot divides the distance between the outer two as the
place where the image cuts the middle wire divides the distance between its crossings with the outer wires.
Each N thus gives one point in the phantom, whatever the scale of the pixels.

References
----------
.. [1] R. M. Comeau, A. Fenster and T. M. Peters, "Integrated MR and ultrasound imaging for improved image
   guidance in neurosurgery", Proc. SPIE 3338, 1998.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from calibration.detection.labelling import label_by_calibration, label_dots
from calibration.points import Detections, ImagePoints
from calibration.wires import Wires, solve_wires
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.wires import WirePhantom

_PLUS_SHARE = 0.95
"""Share of the errors of which PLUS reports mean and standard deviation, the least ones."""


def trimmed_mean_mm(errors_mm: FloatArray) -> tuple[float, float]:
    """Mean and standard deviation of the least 95 % of the errors, mm, as PLUS reports them.

    Raises
    ------
    InsufficientDataError
        If there are none.
    """
    least = np.sort(errors_mm)[: round(_PLUS_SHARE * len(errors_mm))]
    if least.size == 0:
        raise InsufficientDataError("expected an N with all three dots, got none")
    return float(least.mean()), float(least.std())


def middle_wires(points: ImagePoints, phantom: WirePhantom) -> tuple[ImagePoints, FloatArray]:
    """Find where images cut the middle wires, from all N whose three dots are there.

    Parameters
    ----------
    points : ImagePoints
        With the wire of each.

    Returns
    -------
    middle : ImagePoints, length n
        The middle dots, one N after another.
    phantom_mm : ndarray, shape (n, 3)
        Where they are in the phantom's frame, from the distances of the outer dots.

    Raises
    ------
    InvalidInputError
        If the points have no wires.
    """
    # Number of the point that shows each wire in each frame; none is -1.
    point_of = np.full((points.frame.max(initial=0) + 1, len(phantom)), -1)
    point_of[points.frame, points.wires] = np.arange(len(points))
    middles, places = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for shape, crossings in zip(phantom.n_shapes, phantom.crossings_mm(), strict=True):
        together = point_of[:, list(shape)]
        first, middle, last = together[(together >= 0).all(axis=1)].T
        to_middle, between = (points.pixels[k] - points.pixels[first] for k in (middle, last))
        share = np.linalg.norm(to_middle, axis=1) / np.linalg.norm(between, axis=1)
        middles.append(middle)
        places.append(crossings[0] + share[:, None] * (crossings[1] - crossings[0]))
    return points[np.concatenate(middles)], np.concatenate(places)


def nwire_errors_mm(
    points: ImagePoints,
    phantom: WirePhantom,
    sensor_from_pixels: FloatArray,
    world_from_phantom: RigidTransform,
) -> FloatArray:
    """Distances of middle dots from where the outer dots say they are: PLUS's 3-D reprojection error.

    Parameters
    ----------
    points : ImagePoints
        With the wire of each; all N whose three dots are there count.
    sensor_from_pixels : ndarray, shape (4, 4)
        Affine: PLUS's ``ImageToProbe``, or `Calibration.pixel_matrix`.

    Returns
    -------
    ndarray, shape (n,)
        In the order of `middle_wires`.

    Raises
    ------
    InvalidInputError
        If the points have no wires.
    """
    middle, phantom_mm = middle_wires(points, phantom)
    dots = middle.pixels @ sensor_from_pixels[:3, :2].T + sensor_from_pixels[:3, 3]
    expected = (middle.world_from_sensor.inv() * world_from_phantom).apply(phantom_mm)
    return np.asarray(np.linalg.norm(dots - expected, axis=1))


def label_by_wires(
    dots: Detections, phantom: WirePhantom, world_from_sensor: RigidTransform, pixel_mm: FloatArray
) -> Detections:
    """Assign dots to wires, first by themselves, then by the calibration that follows from most frames.

    Parameters
    ----------
    world_from_sensor : RigidTransform
        One for each frame of the sequence.
    pixel_mm : ndarray, shape (2,)
        Rough distance between columns and between rows, mm.

    Raises
    ------
    InsufficientDataError, InvalidInputError
        See `label_dots` and `solve_wires`.
    """
    alone = label_dots(dots, phantom, pixel_mm)
    if len(alone) == 0:
        reason = min(alone.dropped.values(), default="no frames")
        raise InsufficientDataError(f"expected frames that show all wires, got none: {reason}")
    solution = solve_wires(alone.points(world_from_sensor[alone.frame]), phantom)
    assert isinstance(solution.phantom, Wires)
    return label_by_calibration(dots, solution.phantom.geometry, solution.chain, world_from_sensor)
