"""Poses as a table of pandas, frames as a labelled array of xarray."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.extras import extra_module
from speckle3d.core.geometry import elevational_steps, roll_yaw_tilt

if TYPE_CHECKING:
    from speckle3d.core.sweep import Sweep

_PLACES = ("x_mm", "y_mm", "z_mm")
_ANGLES = ("tilt_deg", "yaw_deg", "roll_deg")


def poses_table(
    world_from_image: RigidTransform,
    centre_mm: FloatArray,
    time_s: FloatArray | None = None,
    covariance: FloatArray | None = None,
    flags: IntArray | None = None,
) -> Any:
    """Poses of frames as a table, a row for each.

    Parameters
    ----------
    world_from_image : RigidTransform, length n
    centre_mm : ndarray, shape (3,)
        A point of the image: its place is told, and the length that it travels along the image's normal.
    time_s : ndarray, shape (n,), optional
    covariance : ndarray, shape (n, 6, 6), optional
        Of x, y, z (mm), tilt, yaw, roll (rad); its standard deviations become columns ``sigma_...``.
    flags : ndarray of int, shape (n,), optional
        Zero for frames to be trusted.

    Returns
    -------
    pandas.DataFrame
        Indexed by frame, from 0; units at the end of columns' names. Angles are those of the turn from the
        first frame.
    """
    pandas = extra_module("pandas", "notebook", "a table of poses")
    columns: dict[str, Any] = {} if time_s is None else {"time_s": time_s}
    columns |= dict(zip(_PLACES, world_from_image.apply(centre_mm).T, strict=True))
    turned = roll_yaw_tilt(world_from_image[0].rotation.inv() * world_from_image.rotation)
    columns |= dict(zip(_ANGLES, np.rad2deg(turned).T[::-1], strict=True))
    columns["length_mm"] = np.concatenate([[0.0], np.cumsum(elevational_steps(world_from_image, centre_mm))])
    if covariance is not None:
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).clip(min=0.0))
        sigma[:, 3:] = np.rad2deg(sigma[:, 3:])
        columns |= {f"sigma_{name}": sigma[:, i] for i, name in enumerate((*_PLACES, *_ANGLES))}
    if flags is not None:
        columns["flags"] = flags
    return pandas.DataFrame(columns, index=pandas.RangeIndex(len(world_from_image), name="frame"))


def frames_array(sweep: Sweep) -> Any:
    """All frames of a sweep as a labelled array; they are read into memory.

    Returns
    -------
    xarray.DataArray
        Dimensions ``frame``, ``lateral_mm`` and ``depth_mm``, and the coordinate ``time_s`` along the first.
    """
    xarray = extra_module("xarray", "notebook", "a labelled array")
    grid = sweep.grid
    lateral = np.arange(grid.vectors) * grid.vector_pitch_mm
    depth = grid.first_sample_depth_mm + np.arange(grid.samples) * grid.sample_spacing_mm
    return xarray.DataArray(
        np.stack([np.asarray(sweep.frames[i]) for i in range(len(sweep))]),
        dims=("frame", "lateral_mm", "depth_mm"),
        coords={
            "frame": np.arange(len(sweep)),
            "time_s": ("frame", sweep.frame_time_s, {"units": "s"}),
            "lateral_mm": ("lateral_mm", lateral, {"units": "mm"}),
            "depth_mm": ("depth_mm", depth, {"units": "mm"}),
        },
        name=sweep.name,
        attrs={"long_name": "echo", "units": "1"},
    )


def poses_array(world_from_image: RigidTransform, time_s: FloatArray | None = None) -> Any:
    """Poses as a labelled array of rigid matrices, mm.

    Returns
    -------
    xarray.DataArray
        Dimensions ``frame``, ``row`` and ``column``.
    """
    xarray = extra_module("xarray", "notebook", "a labelled array")
    coords: dict[str, Any] = {"frame": np.arange(len(world_from_image))}
    if time_s is not None:
        coords["time_s"] = ("frame", time_s, {"units": "s"})
    return xarray.DataArray(
        world_from_image.as_matrix(),
        dims=("frame", "row", "column"),
        coords=coords,
        name="world_from_image",
        attrs={"units": "mm", "long_name": "rigid matrices, image coordinates to the mode's world"},
    )
