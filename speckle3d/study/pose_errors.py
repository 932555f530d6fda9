"""Joint errors of the poses of a reconstruction's modes, from what its file claims; measurements by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.poses import PoseErrors
from speckle3d.core.reconstruction import Reconstruction, SharedErrors
from speckle3d.imaging.measures.belonging import require_inside
from speckle3d.imaging.measures.measure import Measurement, measure_points
from speckle3d.motion.uncertainty import joint_errors
from speckle3d.scoring.modes import default_mode
from speckle3d.scoring.trajectories import poses_of

PICKING = 0.5
"""Standard deviation of a picked point's place on each axis, over the distance of the image's vectors."""


def measure(
    reconstruction: Reconstruction,
    points_mm: FloatArray,
    mode: str | None = None,
    pick_mm: float | None = None,
) -> list[Measurement]:
    """Measure distances and angles between points of a reconstructed sweep with their errors.

    Parameters
    ----------
    reconstruction : Reconstruction
        Its pairs are not needed.
    points_mm : ndarray, shape (k, 3)
        In the world of the mode, in order.
    mode : str, optional
        At whose poses the points were picked; by default those that claim the smallest error of length.
    pick_mm : float, optional
        Standard deviation of each point's place on each axis by picking; by default half the distance of the
        image's vectors.

    Returns
    -------
    list of Measurement
        Distances from each point to the next; of three points and more also the length of the line through
        all, and the angles between.

    Raises
    ------
    InvalidInputError
        If there are fewer than two points, one lies outside the sweep, or there is no such mode.
    MismatchError
        If no mode is named, and modes differ by more than three joint claims.
    InsufficientDataError
        As `errors_of`.
    """
    points = np.asarray(points_mm, dtype=float).reshape(-1, 3)
    mode = default_mode(reconstruction)[0] if mode is None else mode
    errors, grid = errors_of(reconstruction, mode), reconstruction.grid
    near = require_inside(points, grid, errors.world_from_image)
    return measure_points(
        points, near, errors, PICKING * grid.vector_pitch_mm if pick_mm is None else pick_mm
    )


def how_measured(mode: str, pick_mm: float) -> str:
    """What the errors of measurements are."""
    return f"mode {mode}; points are picked to +- {1.96 * pick_mm:.2g} mm per axis; every +- is 95 %"


def caution(reconstruction: Reconstruction, mode: str) -> str | None:
    """Warning beside errors of a mode that claims none of its own; None if it does.

    The images' errors are taken then: too large along the sweep of a good tracker, too small across it.
    """
    trust = reconstruction.trust
    if mode == "image" or (trust is not None and mode in trust.modes):
        return None
    return f"mode {mode} claims no errors of its own: those of the images are taken"


def errors_of(reconstruction: Reconstruction, mode: str = "image") -> PoseErrors:
    """Joint errors of the poses of one mode, with these poses.

    `image`: what the file holds. Other modes: their own claims; the claimed error of the length stretches the
    whole sweep, and what the covariances have beyond it has grown from frame to frame. `consistent-subset`,
    and `orientation` and `pose` of older files, claim nothing: the images' errors are taken.

    Parameters
    ----------
    reconstruction : Reconstruction
        Its pairs are not needed.
    mode : str

    Raises
    ------
    InvalidInputError
        If there is no such mode.
    InsufficientDataError
        If the file says nothing about errors, as the oldest do.
    """
    poses, trust = poses_of(reconstruction, mode), reconstruction.trust
    if trust is None:
        raise InsufficientDataError(
            "expected a reconstruction that says how far to trust its poses, got an older one: "
            "make it again (speckle3d reconstruct)"
        )
    centre = reconstruction.grid.centre_mm
    if mode in trust.modes:
        claim = trust.modes[mode]
        stretch = SharedErrors(0.0, claim.length_sigma, np.zeros(2))
        return joint_errors(claim.covariance, poses, centre, stretch)
    images = joint_errors(trust.covariance, reconstruction.poses["image"], centre, trust.shared)
    return replace(images, world_from_image=poses)
