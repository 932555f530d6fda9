"""Images among wires, each by itself: origin and axes, or pose and pixel size, of many hypotheses at once.

Every dot on a wire gives equations that are linear in the image's origin and its two axes, of any lengths
and at any angle.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.geometry import nearest_rotation, skew
from speckle3d.core.wires import WirePhantom

_RIDGE_MM2 = 1e-3
"""Holds axes that the wires leave open near zero; a dot 10 mm off the centre weighs 100 mm^2."""
_STEPS = 10
_DAMPING = 1e-4
_DOT_MM = 0.3
"""How far a dot is from its wire, typically: what the pixel size's uncertainty is weighed against."""


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
    matrix = affine_equations(positions_mm, rows).reshape(b, 2 * m, 9)
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


def affine_equations(places: FloatArray, rows: FloatArray) -> FloatArray:
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
