"""Frames that lie on the image and on the phantom, in which all angles to be found are small.

There no fixed angle is near its singularity, wherever the sensor is mounted, and parameters are well scaled.
"""

from __future__ import annotations

import numpy as np

from calibration.chain import CHAIN, Chain, ImagePoints, Phantom
from calibration.equations import BareChain, Equations, columns_of
from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import skew


def near_jacobian(
    points: ImagePoints, phantom: Phantom, chain: Chain, free: tuple[str, ...]
) -> tuple[FloatArray, FloatArray]:
    """Residuals, shape (n r,), and Jacobian, (n r, p), in frames that lie on the image and on the phantom."""
    bare = BareChain.of(chain)
    return Equations.of(points, phantom).near(bare).derivatives(bare.on_image, columns_of(free))


def moved_by(chain: Chain, free: tuple[str, ...], step: FloatArray) -> Chain:
    """Add a step in the free parameters, in frames that lie on the image and on the phantom."""
    bare = BareChain.of(chain)
    parameters = bare.on_image
    parameters[columns_of(free)] += step
    return bare.moved_to(parameters).chain


def corners_moved(chain: Chain, points: ImagePoints) -> FloatArray:
    """Derivatives of the image's corners, mm, by all parameters, in frames that lie on the image and phantom.

    The image is taken to reach as far as points are in it. Shape (4, 3, 14).
    """
    right, bottom = points.pixels.max(axis=0)
    corners_px = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
    flat = np.column_stack([corners_px * chain.pixel_mm, np.zeros(len(corners_px))])
    moved = np.zeros((len(corners_px), 3, len(CHAIN)))
    moved[:, 0, 0], moved[:, 1, 1] = corners_px.T
    moved[:, :, 2:5] = np.eye(3)
    moved[:, :, 7:4:-1] = -skew(flat)
    return moved
