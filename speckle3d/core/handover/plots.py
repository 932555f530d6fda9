"""Poses of frames drawn: length and angles against the frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import elevational_steps, roll_yaw_tilt

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = {
    "image": "#D55E00",
    "consistent-subset": "#E69F00",
    "orientation": "#0072B2",
    "pose": "#009E73",
    "crossed": "#CC79A7",
    "inertial": "#56B4E9",
    "fused": "#882255",
}
_INTERVAL = "95 % interval of mode image"
_WITHIN = 1.96
"""Standard deviations to either side that hold 95 %."""


def plot_poses(
    poses: Mapping[str, RigidTransform], centre_mm: FloatArray, covariance: FloatArray | None = None
) -> Figure:
    """Draw length, tilt, yaw and roll of every mode against the frame.

    Parameters
    ----------
    poses : mapping of str to RigidTransform, each of length n
        ``world_from_image`` by mode.
    centre_mm : ndarray, shape (3,)
        The point of the image whose travel is the length.
    covariance : ndarray, shape (n, 6, 6), optional
        Of mode `image`: its 95 % interval is shaded.
    """
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 4, figsize=(13.0, 3.2), layout="constrained")
    pyplot.close(figure)  # it is shown by whom it is returned to, once
    for mode, world_from_image in poses.items():
        told = _quantities(world_from_image, centre_mm)
        for panel, (name, values) in zip(axes, told.items(), strict=True):
            panel.plot(values, color=_COLOURS.get(mode), label=f"mode {mode}")
            panel.set(xlabel="frame", ylabel=name)
            panel.grid(alpha=0.3)
    if covariance is not None and "image" in poses:
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).clip(min=0.0))
        half = _WITHIN * np.column_stack([sigma[:, 2], np.rad2deg(sigma[:, 3:6])])
        told = _quantities(poses["image"], centre_mm)
        for panel, values, width in zip(axes, told.values(), half.T, strict=True):
            band = np.arange(values.size), values - width, values + width
            panel.fill_between(*band, color=_COLOURS["image"], alpha=0.15, linewidth=0, label=_INTERVAL)
    axes[0].legend(fontsize="small", frameon=False)
    return figure


def _quantities(world_from_image: RigidTransform, centre_mm: FloatArray) -> dict[str, FloatArray]:
    steps = elevational_steps(world_from_image, centre_mm)
    turned = np.rad2deg(roll_yaw_tilt(world_from_image[0].rotation.inv() * world_from_image.rotation))
    return {
        "length / mm": np.concatenate([[0.0], np.cumsum(steps)]),
        "tilt / degrees": turned[:, 2],
        "yaw / degrees": turned[:, 1],
        "roll / degrees": turned[:, 0],
    }
