"""Frames that lie on the image and on the phantom, in which all angles to be found are small.

There no fixed angle is near its singularity, wherever the sensor is mounted, and parameters are well scaled.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.chain import CHAIN, Chain, ImagePoints, Phantom, residuals_and_jacobian
from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import skew


def near_jacobian(
    points: ImagePoints, phantom: Phantom, chain: Chain, free: tuple[str, ...]
) -> tuple[FloatArray, FloatArray]:
    """Residuals, shape (n r,), and Jacobian, (n r, p), in frames that lie on the image and on the phantom."""
    near = replace(points, world_from_sensor=chain.target_from_image(points))
    residuals, jacobian = residuals_and_jacobian(on_image(chain), near, phantom)
    columns = [CHAIN.index(name) for name in free]
    return residuals.ravel(), jacobian.reshape(-1, len(CHAIN))[:, columns]


def moved_by(chain: Chain, free: tuple[str, ...], step: FloatArray) -> Chain:
    """Add a step in the free parameters, in frames that lie on the image and on the phantom."""
    parameters = on_image(chain)
    parameters[[CHAIN.index(name) for name in free]] += step
    return moved_to(chain, parameters)


def on_image(chain: Chain) -> FloatArray:
    """Parameters of a chain in frames that lie on the image and on the phantom: zero but for pixel sizes."""
    return np.concatenate([chain.pixel_mm, np.zeros(len(CHAIN) - 2)])


def moved_to(chain: Chain, parameters: FloatArray) -> Chain:
    """Replace the parameters of `on_image` by others."""
    step = Chain.from_parameters(parameters)
    return Chain(
        step.pixel_mm,
        chain.sensor_from_image * step.sensor_from_image,
        step.target_from_world * chain.target_from_world,
    )


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
