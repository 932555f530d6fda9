"""Joint errors of the poses of a reconstruction's modes, from what its file claims; measurements by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.poses import ERROR_STEPS, PoseErrors
from speckle3d.core.reconstruction import Reconstruction, SharedErrors
from speckle3d.imaging.measures.belonging import require_inside
from speckle3d.imaging.measures.measure import Measurement, measure_points
from speckle3d.motion.uncertainty import common_factors, travel
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


def joint_errors(
    covariance: FloatArray,
    world_from_image: RigidTransform,
    centre_mm: FloatArray,
    shared: SharedErrors | None,
) -> PoseErrors:
    """Errors of all frames together whose covariances, frame by frame, are those given.

    What all frames have in common is carried as it was claimed. The rest has grown along the way: errors of
    two frames are correlated as a random walk's, by the root of the ratio of their ways.

    Parameters
    ----------
    covariance : ndarray, shape (n, 6, 6)
        Of (x, y, z, tilt, yaw, roll) about the image's centre along the first frame's axes, mm and rad.
    world_from_image : RigidTransform, length n
    centre_mm : ndarray, shape (3,)
    shared : SharedErrors or None
        Which part of `covariance` all frames have in common; None: none of it.
    """
    poses = world_from_image[0].inv() * world_from_image
    common = common_factors(poses, centre_mm, shared or SharedErrors(0.0, 0.0, np.zeros(2)))
    remainder = covariance - np.einsum("mia,mib->iab", common, common)
    # In units of the whole, and no less than nothing: what all have in common may be more than a frame's own.
    size = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 1e-24))
    value, axes = np.linalg.eigh(remainder / (size[:, :, None] * size[:, None, :]))
    root = size[:, :, None] * (axes * np.sqrt(np.maximum(value, 0.0))[:, None, :]) @ axes.transpose(0, 2, 1)
    way = np.maximum(travel(poses, centre_mm), 1e-6)
    begin, width = np.linspace(0.0, way[-1], ERROR_STEPS, endpoint=False), way[-1] / ERROR_STEPS
    share = np.sqrt(np.clip(way - begin[:, None], 0.0, width) / way)
    grown = np.einsum("ki,iam->kmia", share, root).reshape(-1, len(poses), 6)
    factors = np.concatenate([common, grown])
    return PoseErrors(factors[np.abs(factors).max(axis=(1, 2)) > 1e-12], world_from_image, centre_mm)
