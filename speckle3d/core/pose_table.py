"""Poses of frames as a table of pandas and as curves: places, angles, length."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.extras import extra_module
from speckle3d.core.geometry import elevational_steps, roll_yaw_tilt

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NAMES = ("x_mm", "y_mm", "z_mm", "tilt_deg", "yaw_deg", "roll_deg")
_PANELS = ("length_mm", *_NAMES[3:])
_WITHIN = 1.96
"""Standard deviations to either side that hold 95 %."""


def pose_table(
    world_from_image: RigidTransform,
    centre_mm: FloatArray,
    covariance: FloatArray | None = None,
    **others: FloatArray | IntArray | None,
) -> Any:
    """Poses as a `pandas.DataFrame` indexed by frame, from 0, units at the end of the columns' names.

    Parameters
    ----------
    world_from_image : RigidTransform, length n
    centre_mm : ndarray, shape (3,)
        A point of the image: its place is told, and the length that it travels along the image's normal.
        Angles are those of the turn from the first frame.
    covariance : ndarray, shape (n, 6, 6), optional
        Of x, y, z (mm), tilt, yaw, roll (rad); its standard deviations become columns ``sigma_...``.
    **others : ndarray, shape (n,), or None
        Further columns.
    """
    pandas = extra_module("pandas", "notebook", "a table of poses")
    columns = {**others, **_columns(world_from_image, centre_mm, covariance)}
    table = pandas.DataFrame({name: values for name, values in columns.items() if values is not None})
    return table.rename_axis(index="frame")


def _columns(
    world_from_image: RigidTransform, centre_mm: FloatArray, covariance: FloatArray | None
) -> dict[str, FloatArray]:
    turned = roll_yaw_tilt(world_from_image[0].rotation.inv() * world_from_image.rotation)
    values = [*world_from_image.apply(centre_mm).T, *np.rad2deg(turned).T[::-1]]
    columns = dict(zip(_NAMES, values, strict=True))
    columns["length_mm"] = np.append(0.0, np.cumsum(elevational_steps(world_from_image, centre_mm)))
    if covariance is not None:
        variance = np.diagonal(covariance, axis1=1, axis2=2).clip(min=0.0)
        sigma = np.sqrt(variance) * np.repeat([1.0, np.rad2deg(1.0)], 3)
        columns |= {f"sigma_{name}": column for name, column in zip(_NAMES, sigma.T, strict=True)}
    return columns


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
        columns = _columns(world_from_image, centre_mm, covariance if mode == "image" else None)
        for panel, name in zip(axes, _PANELS, strict=True):
            (line,) = panel.plot(columns[name], label=f"mode {mode}")
            panel.set(xlabel="frame", ylabel=name.replace("_deg", " / degrees").replace("_mm", " / mm"))
            sigma = columns.get(f"sigma_{name}".replace("length", "z"))
            if sigma is not None:
                half, look = _WITHIN * sigma, {"color": line.get_color(), "alpha": 0.15, "lw": 0}
                low, high = columns[name] - half, columns[name] + half
                panel.fill_between(range(half.size), low, high, label=f"95 % interval of mode {mode}", **look)
    axes[0].legend(fontsize="small", frameon=False)
    return figure
