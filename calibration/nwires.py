"""N-wire phantoms: points of the image in the phantom from three dots each, and a start for the calibration.

The outer wires of an N are parallel, so that the middle dot divides the distance between the outer two as the
place where the image cuts the middle wire divides the distance between its crossings with the outer wires.
Each N thus gives one point in the phantom, whatever the scale of the pixels.

References
----------
.. [1] R. M. Comeau, A. Fenster and T. M. Peters, "Integrated MR and ultrasound imaging for improved image
   guidance in neurosurgery", Proc. SPIE 3338, 1998.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.detection.dots import Dots
from calibration.detection.labelling import label_by_calibration, label_dots
from calibration.plane import Chain
from calibration.points import ImagePoints, Seen, affine_equations
from calibration.robust import cauchy_weights, robust_linear
from calibration.wires import wire_start
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.wires import WirePhantom

_PLUS_SHARE = 0.95
"""Share of the errors of which PLUS reports mean and standard deviation, the least ones."""
_REWEIGHTINGS = 10
_FEWEST_POINTS = 9
"""Three equations each, for nine unknowns, and twice as many again to tell a wrong one."""
_LEAST_SINGULAR = 1e-4
"""Least ratio of singular values at which the linear problem is determined: at a smaller one, noise of 0.01
mm moves the answer by the image's own size."""
_FAR = 2.698
"""Distance, in robust standard deviations (four medians), at which a point has half its weight."""


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
        Affine: PLUS's ``ImageToProbe``, `Calibration.pixel_matrix`, or `pixel_matrix` of a chain.

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


def pixel_matrix(chain: Chain) -> FloatArray:
    """Affine matrix from pixels (column, row, 0, 1) to the sensor's frame in mm, shape (4, 4)."""
    scale = np.diag([*chain.pixel_mm, float(chain.pixel_mm.mean()), 1.0])
    return np.asarray(chain.sensor_from_image.as_matrix() @ scale)


def start_from_nwires(points: ImagePoints, phantom: WirePhantom) -> Chain:
    """Calibrate in closed form: least squares of the errors of `nwire_errors_mm`, [1]_ (see `wire_start`).

    Parameters
    ----------
    points : ImagePoints
        With the wire of each.
    phantom : WirePhantom
        Where its own place is not known, that is found first.

    Raises
    ------
    InsufficientDataError
        If the points are too few, or do not determine the answer.
    InvalidInputError
        If the points have no wires.

    References
    ----------
    .. [1] R. M. Comeau et al., 1998, see this module.
    """
    middle, phantom_mm = middle_wires(points, phantom)
    if len(middle) < _FEWEST_POINTS:
        raise InsufficientDataError(
            f"expected at least {_FEWEST_POINTS} middle dots of N to start from, got {len(middle)}"
        )
    weights = partial(cauchy_weights, limit=_FAR)
    place = phantom.world_from_phantom
    if place is None:
        place = _place(middle, phantom_mm)
    equations = np.broadcast_to(np.eye(3), (len(middle), 3, 3)), phantom_mm
    return wire_start(middle, equations, place.inv(), weights, _REWEIGHTINGS, _LEAST_SINGULAR)[0]


def _place(middle: ImagePoints, phantom_mm: FloatArray) -> RigidTransform:
    """Find ``world_from_phantom``: linear equations of its matrix and the image's origin and axes."""
    spread, centre = middle.pixels.std() or 1.0, middle.pixels.mean(axis=0)
    image = affine_equations((middle.pixels - centre) / spread, middle.turns)
    near = phantom_mm - phantom_mm.mean(axis=0)
    phantom = affine_equations(near[:, :2], np.broadcast_to(np.eye(3), (len(near), 3, 3)))
    third = near[:, 2, None, None] * np.eye(3)
    matrix = np.concatenate([image, -phantom, -third], axis=2)
    fit = robust_linear(
        matrix, -middle.shifts_mm, partial(cauchy_weights, limit=_FAR), _REWEIGHTINGS, _LEAST_SINGULAR
    )
    if fit.rank < fit.parameters.size:
        raise InsufficientDataError("the sensor turned too little to find where the phantom is")
    axes = fit.parameters[12:].reshape(3, 3).T
    turn = Rotation.from_matrix(nearest_rotation(axes))
    return RigidTransform.from_components(fit.parameters[9:12] - turn.apply(phantom_mm.mean(axis=0)), turn)


def label_and_start(
    dots: Dots,
    phantom: WirePhantom,
    world_from_sensor: RigidTransform,
    pixel_mm: npt.ArrayLike,
) -> tuple[Seen, Chain]:
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
        See `label_dots` and `start_from_nwires`.
    """
    if len(dots.frame) and dots.frame[-1] >= len(world_from_sensor):
        raise MismatchError(f"expected a pose for frame {dots.frame[-1]}, got {len(world_from_sensor)} poses")
    alone = label_dots(dots, phantom, pixel_mm)
    if len(alone) == 0:
        reasons = sorted(set(alone.dropped.values())) or ["no frames"]
        raise InsufficientDataError(f"expected frames that show all wires, got none: {reasons[0]}")
    start = start_from_nwires(alone.points(world_from_sensor[alone.frame]), phantom)
    found = label_by_calibration(dots, phantom, start, world_from_sensor)
    registered = replace(phantom, world_from_phantom=start.target_from_world.inv())
    return found, start_from_nwires(found.points(world_from_sensor[found.frame]), registered)


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
