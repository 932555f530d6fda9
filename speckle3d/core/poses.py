"""Poses of frames: measured between them, with the joint errors of all, as a table and as curves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.extras import extra_module
from speckle3d.core.geometry import elevational_steps, mirrored, roll_yaw_tilt
from speckle3d.core.text import shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = ("x_mm", "y_mm", "z_mm", "tilt_deg", "yaw_deg", "roll_deg")

MIRROR = np.diag([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])
"""What a mirror in the first image's plane does to (x, y, z, tilt, yaw, roll)."""


SHARED = np.array([3.2, 3.8, 1.4, 1.4, 1.4, 4.5])
"""Deviations of (x, y, z, tilt, yaw, roll) over what the graph has them if pairs were independent: pairs
that share a frame share its speckle, and in-plane shifts their interpolation's error. Measured on simulated
phantoms, as the other figures here."""
STRUCTURE = np.array([19.0, 0.0, 0.0, 0.0, 0.0, 8.0])
"""Growth of these with the share of echoes that stay: structure that runs across hides motion along it."""
SIDEWAYS, SIDEWAYS_BY_SHARE = 0.005, np.array([0.5, 0.1])
"""Motion along x and y that images see for each mm along z where structure runs across, standard deviation:
least, and its growth with the share of echoes that stay. Of simulated phantoms and tissue."""
SCALE_CHANGE_MM = 2.0
"""Travel over which the error of the scale changes, with the tissue."""
TURN_CHANGE_MM = 40.0
"""Travel up to which a hand's turns wander rather than go on: with a steady rate of 0.05 degrees/mm they
grow to 0.3 degrees in 1 mm, 0.7 in 4, 1.0 in 8 and 2.0 in 24. Tracked hands over phantoms turn by 0.3, 0.7 to
0.9, 1.0 to 1.7 and 1.7 to 4.5 about each axis."""

ERROR_STEPS = 40
"""Places along a sweep at which its errors are computed; between them they are interpolated."""

HELD = np.repeat([1.0, 0.05], 3)
"""How far a probe may go between two frames that no pair joins, deviations of (x, y, z, tilt, yaw, roll), mm
and rad: 25 mm and 70 degrees in a second at 25 frames."""


@shown
@dataclass(frozen=True)
class RelativePoses:
    """Edges of the graph: the second frame's pose in the first, about the image's centre.

    Attributes
    ----------
    first, second : ndarray, shape (e,)
    poses : RigidTransform, length e
    covariance : ndarray, shape (e, 6, 6)
        Of (x, y, z, tilt, yaw, roll), mm and rad.
    """

    first: IntArray
    second: IntArray
    poses: RigidTransform
    covariance: FloatArray

    def __len__(self) -> int:
        return int(self.first.size)

    def mirrored(self) -> RelativePoses:
        """Edges of the mirrored sweep."""
        return RelativePoses(self.first, self.second, mirrored(self.poses), MIRROR @ self.covariance @ MIRROR)


@shown
@dataclass(frozen=True)
class PoseErrors:
    """Joint errors of all frames' poses: `factors`, contracted with independent standard normal variables.

    Parameters
    ----------
    factors : ndarray, shape (m, n, 6)
        Of m variables and n frames: (x, y, z, tilt, yaw, roll) about the image's centre, along the first
        frame's axes, mm and rad.
    world_from_image : RigidTransform, length n
    centre_mm : ndarray, shape (3,)
        The image's centre, in the image.

    Examples
    --------
    One variable, an error of the scale of 2 %, in three frames 1 mm apart:

    >>> factors = np.zeros((1, 3, 6))
    >>> factors[0, :, 2] = 0.02 * np.arange(3)
    >>> errors = PoseErrors(factors, RigidTransform.identity(3), np.zeros(3))
    >>> np.linalg.norm(errors.factors[:, :, 2], axis=0).round(3).tolist()
    [0.0, 0.02, 0.04]
    """

    factors: FloatArray
    world_from_image: RigidTransform
    centre_mm: FloatArray


def pose_table(
    world_from_image: RigidTransform,
    centre_mm: FloatArray,
    covariance: FloatArray | None = None,
    **others: FloatArray | IntArray,
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
    **others : ndarray, shape (n,)
        Further columns.
    """
    columns = others | _columns(world_from_image, centre_mm, covariance)
    table = extra_module("pandas", "notebook", "a table of poses").DataFrame(columns)
    return table.rename_axis(index="frame")


def _columns(
    world_from_image: RigidTransform, centre_mm: FloatArray, covariance: FloatArray | None
) -> dict[str, FloatArray]:
    turned = roll_yaw_tilt(world_from_image[0].rotation.inv() * world_from_image.rotation)
    values = [*world_from_image.apply(centre_mm).T, *np.rad2deg(turned).T[::-1]]
    columns = dict(zip(_COLUMNS, values, strict=True))
    columns["length_mm"] = np.append(0.0, np.cumsum(elevational_steps(world_from_image, centre_mm)))
    if covariance is not None:
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).clip(min=0.0))
        sigma[:, 3:] = np.rad2deg(sigma[:, 3:])
        columns |= {f"sigma_{name}": column for name, column in zip(_COLUMNS, sigma.T, strict=True)}
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
        for panel, name in zip(axes, ("length_mm", *_COLUMNS[3:]), strict=True):
            (line,) = panel.plot(columns[name], label=f"mode {mode}")
            panel.set(xlabel="frame", ylabel=name.replace("_", " / "))
            sigma = columns.get(f"sigma_{name}".replace("length", "z"))
            if sigma is not None:
                half = 1.96 * sigma
                panel.fill_between(
                    range(half.size),
                    columns[name] - half,
                    columns[name] + half,
                    color=line.get_color(),
                    alpha=0.15,
                    lw=0,
                    label="its 95 % interval",
                )
    axes[0].legend(fontsize="small")
    return figure
