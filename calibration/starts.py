"""Where iterations start: closed-form estimates of the whole chain that need no guess.

For a plane, mountings are tried all over against the directions of its lines; the distances are then linear.
For wires, every dot gives equations that are linear in the image's origin and its two axes, of any lengths
and at any angle: in the phantom's frame for one image (`free_fits`, `rigid_fits`, many hypotheses at once),
in the sensor's frame for all images of a recording (`wire_start`).

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, appendix A (the stages; they are iterative there).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import Chain, ImagePoints
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import nearest_rotation, skew
from speckle3d.core.leastsquares import RobustFit, huber_weights, robust_linear
from speckle3d.core.wires import WirePhantom

_NORMALS = 30
_ROTATIONS = 800
"""About 26 and 30 degrees apart: refinement converges from further away."""

NEARLY_ABSOLUTE = partial(huber_weights, limit=0.6745)
"""Least absolute values for residuals above the median, 0.6745 standard deviations."""
_REWEIGHTINGS = 4

_RIDGE_MM2 = 1e-3
"""Holds axes that the wires leave open near zero; a dot 10 mm off the centre weighs 100 mm^2."""
_STEPS = 10
_DAMPING = 1e-4
_DOT_MM = 0.3
"""How far a dot is from its wire, typically: what the pixel size's uncertainty is weighed against."""


def hemisphere() -> FloatArray:
    """Unit vectors spread evenly over the hemisphere z >= 0, the pole first, shape (30, 3)."""
    k = np.arange(_NORMALS)
    z = 1.0 - k / _NORMALS
    around = k * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z**2)
    return np.column_stack([flat * np.cos(around), flat * np.sin(around), z])


def rotations_all_over() -> Rotation:
    """Rotations spread evenly over the whole rotation group.

    References
    ----------
    .. [1] M. Alexa, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)", CVPR, 2022.
    """
    s = np.arange(_ROTATIONS) + 0.5
    t = s / _ROTATIONS
    first, second = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    inner, outer = np.sqrt(t), np.sqrt(1.0 - t)
    parts = (inner * np.sin(first), inner * np.cos(first), outer * np.sin(second), outer * np.cos(second))
    return Rotation.from_quat(np.column_stack(parts))


def angle_starts(
    directions_px: FloatArray, world_from_sensor: Rotation, ratio: float, normals: FloatArray, keep: int = 12
) -> list[Chain]:
    """Try mountings of the sensor and normals of the plane all over, and keep the best; no distances.

    Parameters
    ----------
    directions_px : ndarray, shape (m, 2)
        Columns and rows from one end of each line to the other.
    world_from_sensor : Rotation, length m
    ratio : float
        Column pitch over row spacing.
        The chains have it as their pixel size, with a row spacing of one.
    normals : ndarray, shape (k, 3)
    """
    length = directions_px * [ratio, 1.0]
    flat = length / np.linalg.norm(length, axis=1, keepdims=True)
    up = np.einsum("ki,nij->knj", normals, world_from_sensor.as_matrix())
    tried = rotations_all_over()
    # Half a turn about z leaves the directions of lines as they are.
    tried = tried[tried.as_matrix()[:, 0, 0] >= 0]
    axes = tried.as_matrix()[:, :, :2]
    # Mean absolute sine of the angle between line and plane: wrong lines pull little.
    sines = np.einsum("kni,jia,na->jkn", up, axes, flat, optimize=True)
    costs = np.abs(sines).mean(axis=2)
    best = np.argsort(costs, axis=None)[:keep]
    return [
        Chain(
            np.array([ratio, 1.0]),
            RigidTransform.from_rotation(tried[int(j)]),
            RigidTransform.from_rotation(rotation_to_z(normals[k])),
        )
        for j, k in zip(*np.unravel_index(best, costs.shape), strict=True)
    ]


def in_plane_mirror(rotation: Rotation) -> Rotation:
    """The other rotation that explains the same line directions: half a turn in the image plane."""
    return rotation * Rotation.from_euler("z", np.pi)


def rotation_to_z(normal: FloatArray) -> Rotation:
    """A rotation that turns a plane's normal into the z axis."""
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [normal])[0]


def distance_start(points: ImagePoints, angles: Chain, pixel_mm: FloatArray | None) -> tuple[Chain, float]:
    """Find the distances that belong to given angles, by linear least squares.

    Parameters
    ----------
    pixel_mm : ndarray, shape (2,), optional
        Column pitch and row spacing; estimated without it, from the ratio of those in `angles`.

    Returns
    -------
    chain : Chain
    cost : float
        Median absolute height of the points above the plane, mm.
    """
    turned = angles.sensor_from_image.rotation
    normal = angles.target_from_world.rotation.as_matrix()[2]
    up = normal @ points.turns
    square = angles.pixel_mm / angles.pixel_mm[1] if pixel_mm is None else pixel_mm
    image = (points.pixels * square) @ turned.as_matrix()[:, :2].T
    height = np.einsum("ni,ni->n", up, image)
    one = np.ones((len(points), 1))
    unknown = np.concatenate([up, one] if pixel_mm is not None else [up, one, height[:, None]], axis=1)
    wanted = -points.shifts_mm @ normal - (height if pixel_mm is not None else 0.0)
    fit = robust_linear(unknown, wanted, NEARLY_ABSOLUTE, _REWEIGHTINGS)
    found = fit.parameters
    size = square * (1.0 if pixel_mm is not None else found[4])
    if size[1] < 0:
        turned, size = in_plane_mirror(turned), -size
    chain = Chain(
        size,
        RigidTransform.from_components(found[:3], turned),
        RigidTransform.from_components([0.0, 0.0, found[3]], rotation_to_z(normal)),
    )
    return chain, float(np.median(np.abs(fit.residuals)))


def wire_start(
    points: ImagePoints,
    equations: tuple[FloatArray, FloatArray],
    target_from_world: RigidTransform | Rotation,
    weights: Callable[[FloatArray], FloatArray] = NEARLY_ABSOLUTE,
    rounds: int = _REWEIGHTINGS,
    least_singular: float | None = None,
) -> tuple[Chain, RobustFit]:
    """Find the image among wires from all frames of a recording, by robust linear least squares.

    The axes come out free of the constraint that they be square; the chain has the nearest that are.

    Parameters
    ----------
    equations : (rows, offsets), shapes (n, r, 3) and (n, r)
        ``rows @ position = offsets`` in the phantom's frame, as from `Phantom.vanishing`; those of one point
        get one weight.
    target_from_world : RigidTransform or Rotation
        If a rotation, the translation is found too.
    weights, rounds
        See `robust_linear`.
    least_singular : float, optional
        Ratio of singular values below which the answer counts as not determined.

    Returns
    -------
    chain : Chain
    fit : RobustFit
        Residuals of shape (n, r), mm, before the axes are squared.

    Raises
    ------
    InsufficientDataError
        If the points do not determine the answer, judged by `least_singular`; without it, the smallest
        parameters that explain the points are returned.
    """
    rows, offsets = equations
    shifted = isinstance(target_from_world, Rotation)
    known = (
        RigidTransform.from_rotation(target_from_world)
        if isinstance(target_from_world, Rotation)
        else target_from_world
    )
    # Pixels are centred and scaled, for a well-conditioned matrix.
    centre, spread = points.pixels.mean(axis=0), float(points.pixels.std()) or 1.0
    matrix = _affine_equations(
        (points.pixels - centre) / spread, rows @ known.rotation.as_matrix() @ points.turns
    )
    if shifted:
        matrix = np.concatenate([matrix, rows], axis=2)
    wanted = offsets - np.einsum("nri,ni->nr", rows, known.apply(points.shifts_mm))
    fit = robust_linear(matrix, wanted, weights, rounds, least_singular)
    if least_singular is not None and fit.rank < fit.parameters.size:
        raise InsufficientDataError("the dots do not determine where the image is: too few wires or poses")
    axes = fit.parameters[3:9].reshape(2, 3) / spread
    size = np.linalg.norm(axes, axis=1)
    turn = Rotation.from_matrix(nearest_rotation((axes / size[:, None]).T))
    probe = RigidTransform.from_components(fit.parameters[:3] - centre @ axes, turn)
    shift = RigidTransform.from_translation(fit.parameters[9:] if shifted else np.zeros(3))
    return Chain(size, probe, shift * known), fit


def free_fits(
    positions_mm: FloatArray, wires: IntArray, phantom: WirePhantom
) -> tuple[FloatArray, FloatArray]:
    """Fit origins and axes of images to dots on wires, the axes not constrained to be square.

    Parameters
    ----------
    positions_mm : ndarray, shape (b, m, 2)
        Dots in each image, relative to any point of it.
    wires : ndarray of int, shape (b, m)

    Returns
    -------
    affine : ndarray, shape (b, 3, 3)
        Origin, x axis and y axis in the phantom's frame, as rows.
    rms_mm : ndarray, shape (b,)
        Of the components of the dots' distances from their wires.
    """
    rows, offsets = phantom.equations(wires)
    b, m = wires.shape
    matrix = _affine_equations(positions_mm, rows).reshape(b, 2 * m, 9)
    wanted = offsets.reshape(b, 2 * m)
    normal = np.swapaxes(matrix, 1, 2) @ matrix + _RIDGE_MM2 * np.eye(9)
    found = np.linalg.solve(normal, np.swapaxes(matrix, 1, 2) @ wanted[..., None])
    misfit = (matrix @ found)[..., 0] - wanted
    return np.asarray(found.reshape(b, 3, 3)), np.sqrt(np.mean(misfit**2, axis=1))


def rigid_fits(
    positions_mm: FloatArray, wires: IntArray, phantom: WirePhantom, scale_tolerance: float
) -> tuple[RigidTransform, FloatArray, FloatArray]:
    """Fit poses of images whose pixel size is known to `scale_tolerance`, as a standard deviation.

    Parameters
    ----------
    positions_mm, wires
        See `free_fits`; positions count from the image's origin.

    Returns
    -------
    phantom_from_image : RigidTransform, length b
        Of images whose pixel size is as found.
    scale : ndarray, shape (b, 2)
        Found pixel size over the one given.
    rms_mm : ndarray, shape (b,)
        Of the components of the dots' distances from their wires.
    """
    centre = positions_mm.mean(axis=1)
    seen = positions_mm - centre[:, None]
    affine, _ = free_fits(seen, wires, phantom)
    rows, offsets = phantom.equations(wires)
    origin, turn = affine[:, 0], nearest_rotation(np.swapaxes(affine[:, 1:], 1, 2))
    log_scale = np.zeros((len(seen), 2))
    prior = _DOT_MM / scale_tolerance
    for _ in range(_STEPS):
        residual, jacobian = _linearised(seen * np.exp(log_scale)[:, None], origin, turn, rows, offsets)
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian + np.diag([_DAMPING] * 6 + [prior**2] * 2)
        pull = (np.swapaxes(jacobian, 1, 2) @ residual[..., None])[..., 0]
        pull[:, 6:] += prior**2 * log_scale
        step = -np.linalg.solve(normal, pull[..., None])[..., 0]
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix() @ turn
        origin = origin + step[:, 3:6]
        log_scale = np.clip(log_scale + step[:, 6:], -0.5, 0.5)
    residual, _ = _linearised(seen * np.exp(log_scale)[:, None], origin, turn, rows, offsets)
    scale = np.exp(log_scale)
    corner = origin - np.einsum("bij,bj->bi", turn[:, :, :2], centre * scale)
    pose = RigidTransform.from_components(corner, Rotation.from_matrix(turn))
    return pose, scale, np.sqrt(np.mean(residual**2, axis=1))


def _affine_equations(places: FloatArray, rows: FloatArray) -> FloatArray:
    """Equations of points of an image in its origin and two axes, shape (..., r, 9).

    Parameters
    ----------
    places : ndarray, shape (..., 2)
        In the image.
    rows : ndarray, shape (..., r, 3)
        Of each point's equations for its position.
    """
    lifted = np.concatenate([np.ones((*places.shape[:-1], 1)), places], axis=-1)
    return np.asarray(np.einsum("...k,...ri->...rki", lifted, rows).reshape(*rows.shape[:-1], 9))


def _linearised(
    seen_mm: FloatArray, origin: FloatArray, turn: FloatArray, rows: FloatArray, offsets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals, shape (b, 2m), and derivatives by a small turn, a shift and two logarithms of scale."""
    b, m = seen_mm.shape[:2]
    parts = seen_mm[..., None] * np.swapaxes(turn[:, :, :2], 1, 2)[:, None]
    arm = parts.sum(axis=2)
    residual = np.einsum("bmri,bmi->bmr", rows, arm + origin[:, None]) - offsets
    turned = np.einsum("bmri,bmij->bmrj", rows, -skew(arm))
    scaled = np.einsum("bmri,bmki->bmrk", rows, parts)
    jacobian = np.concatenate([turned, rows, scaled], axis=3)
    return residual.reshape(b, 2 * m), jacobian.reshape(b, 2 * m, 8)
