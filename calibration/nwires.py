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
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from calibration.detection.labelling import label_by_calibration, label_dots
from calibration.points import ImagePoints, Seen
from calibration.wires import Wires, solve_wires
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.wires import WirePhantom

_PLUS_SHARE = 0.95
"""Share of the errors of which PLUS reports mean and standard deviation, the least ones."""


def trimmed_mean_mm(errors_mm: FloatArray, share: float = _PLUS_SHARE) -> tuple[float, float]:
    """Mean and standard deviation of the least `share` of the errors, mm, as PLUS reports them.

    Raises
    ------
    InsufficientDataError
        If there are none.
    """
    kept = np.sort(errors_mm)[: round(share * len(errors_mm))]
    if kept.size == 0:
        raise InsufficientDataError("expected an N with all three dots, got none")
    return float(kept.mean()), float(kept.std())


def middle_wires(points: ImagePoints, phantom: WirePhantom) -> tuple[ImagePoints, FloatArray]:
    """Find where images cut the middle wires, from all N whose three dots are there.

    Parameters
    ----------
    points : ImagePoints
        With the wire of each.

    Returns
    -------
    middle : ImagePoints, length n
        The middle dots.
    phantom_mm : ndarray, shape (n, 3)
        Where they are in the phantom's frame, from the distances of the outer dots.

    Raises
    ------
    InvalidInputError
        If the points have no wires.
    """
    wire = _wires(points, phantom)
    middles, places = [], []
    for shape, crossings in zip(phantom.n_shapes, phantom.crossings_mm(), strict=True):
        first, middle, last = _together(points.frame, wire, shape)
        to_middle, between = (points.pixels[k] - points.pixels[first] for k in (middle, last))
        share = np.linalg.norm(to_middle, axis=1) / np.linalg.norm(between, axis=1)
        middles.append(middle)
        places.append(crossings[0] + share[:, None] * (crossings[1] - crossings[0]))
    index = np.concatenate([np.zeros(0, dtype=np.int64), *middles])
    order = np.argsort(points.frame[index], kind="stable")
    return points[index[order]], np.concatenate([np.zeros((0, 3)), *places])[order]


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
    seen = middle.pixels @ sensor_from_pixels[:3, :2].T + sensor_from_pixels[:3, 3]
    expected = (middle.world_from_sensor.inv() * world_from_phantom).apply(phantom_mm)
    return np.asarray(np.linalg.norm(seen - expected, axis=1))


def label_by_wires(
    dots: Seen, phantom: WirePhantom, world_from_sensor: RigidTransform, pixel_mm: npt.ArrayLike
) -> Seen:
    """Assign dots to wires, first by themselves, then by the calibration that follows from most frames.

    Parameters
    ----------
    world_from_sensor : RigidTransform
        One for each frame of the sequence.
    pixel_mm : array_like, shape (2,)
        Rough distance between columns and between rows, mm.

    Raises
    ------
    InsufficientDataError, InvalidInputError
        See `label_dots` and `solve_wires`.
    """
    if len(dots.frame) and dots.frame[-1] >= len(world_from_sensor):
        raise MismatchError(f"expected a pose for frame {dots.frame[-1]}, got {len(world_from_sensor)} poses")
    alone = label_dots(dots, phantom, pixel_mm)
    if len(alone) == 0:
        reasons = sorted(set(alone.dropped.values())) or ["no frames"]
        raise InsufficientDataError(f"expected frames that show all wires, got none: {reasons[0]}")
    solution = solve_wires(alone.points(world_from_sensor[alone.frame]), phantom)
    assert isinstance(solution.phantom, Wires)
    return label_by_calibration(dots, solution.phantom.geometry, solution.chain, world_from_sensor)


def _wires(points: ImagePoints, phantom: WirePhantom) -> IntArray:
    if points.wire is None:
        raise InvalidInputError("points: expected the wire of each, got none")
    if len(points) and not (int(points.wire.min()) >= 0 and int(points.wire.max()) < len(phantom)):
        raise InvalidInputError(f"points: expected wires from 0 to {len(phantom) - 1}, got others")
    return points.wire


def _together(frame: IntArray, wire: IntArray, shape: tuple[int, ...]) -> list[IntArray]:
    """Of the frames that show all wires of a shape, the numbers of the points, one array for each wire."""
    numbers = [np.flatnonzero(wire == k) for k in shape]
    first = [dict(zip(frame[n].tolist(), n.tolist(), strict=True)) for n in numbers]
    common = sorted(set.intersection(*(set(found) for found in first)))
    return [np.array([found[f] for f in common], dtype=np.int64) for found in first]
