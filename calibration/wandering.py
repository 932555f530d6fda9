"""The end of a calibration: its answer and covariance where the sensor's errors wander.

Plain least squares takes all errors for white and the sensor's poses for exact. But errors that wander make
neighbouring frames say the same: generalised least squares weighs them as they are. And the derivatives
contain the poses' errors, which are in the residuals too, so that pixel sizes come out too small: they are
taken at poses and points corrected by what the residuals say (Gauss and Helmert's model).

References
----------
.. [1] W. A. Fuller, "Measurement error models", Wiley, 1987 (errors in the variables).
.. [2] F. R. Helmert, "Die Ausgleichungsrechnung nach der Methode der kleinsten Quadrate", Teubner, 1907.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import SCALES, Chain, ImagePoints, Phantom, PixelPrior
from calibration.near import moved_by, near_jacobian
from calibration.wander import JITTER, SensorError, WanderingFit, attributed, wandering_fit
from speckle3d.core.arrays import BoolArray, FloatArray

_STEPS = 3
"""The first finds the answer, the second takes the errors out of the derivatives, the third the rest."""
_SETTLED = 0.05
"""Standard errors of a second step below which there is no third."""

_PROPORTIONS_MM = (0.5, 2.0, 8.0)
"""Errors of position over errors of rotation that are tried, mm per degree: trackers are specified at 0.25 mm
with 0.5 degrees to 0.8 mm with 0.15 (TR 303, section 4.2)."""

_LATERAL = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
"""Where a wire runs nearly in the image, its echo is drawn out along it, which is sideways more often than
not, and the crossing is found there less well."""


def settle(
    points: ImagePoints,
    phantom: Phantom,
    chain: Chain,
    free: tuple[str, ...],
    prior: PixelPrior | None = None,
    more: FloatArray | None = None,
) -> tuple[Chain, WanderingFit]:
    """Go from a least-squares solution to the one that knows that the sensor's errors wander.

    Parameters
    ----------
    points : ImagePoints, length n
        Without outliers.
    chain : Chain
        The least-squares solution.
    free : tuple of str, length p
        The parameters estimated.
    prior : PixelPrior, optional
    more : ndarray, shape (n r, k), optional
        Derivatives of the residuals by further parameters, which are zero so far.

    Returns
    -------
    chain : Chain
    noise : WanderingFit
        Its covariance is that of the free parameters in frames that lie on the image and on the phantom, and
        of the further ones after them. Its step is the last one's, of the further ones the sum of all.
    """
    several = phantom.vanishing(points)[1].shape[1]
    group, time_s = np.repeat(points.frame, several), np.repeat(points.times, several)
    jitter = (0.0,) if len(group) == len(points.frames) else JITTER
    corrected, expected = points, np.zeros(len(group))
    beside = np.zeros((len(group), 0)) if more is None else more
    further = np.zeros(beside.shape[1])
    likely: BoolArray | None = None
    for number in range(_STEPS):
        residuals, jacobian = near_jacobian(corrected, phantom, chain, free)
        error = sensor_error(corrected, phantom, chain)
        # What was taken out of the points, put back as the small thing that it is.
        residuals = residuals + expected + beside @ further
        jacobian = np.hstack([jacobian, beside])
        known = _known(prior, chain, free, len(further))
        noise = wandering_fit(jacobian, residuals, group, time_s, error, jitter, *known, likely)
        likely = noise.likely
        sensor, image = attributed(residuals + jacobian @ noise.step, group, error, noise)
        chain = moved_by(chain, free, noise.step[: len(free)])
        further += noise.step[len(free) :]
        corrected, expected = _corrected(points, phantom, chain, sensor, image)
        if number > 0 and (np.abs(noise.step) <= _SETTLED * np.sqrt(np.diag(noise.covariance))).all():
            break
    return chain, replace(noise, step=np.append(noise.step[: len(free)], further))


def _known(
    prior: PixelPrior | None, chain: Chain, free: tuple[str, ...], further: int
) -> tuple[FloatArray | None, FloatArray | None]:
    """Inverse covariance of a prior, and by how much the parameters exceed it."""
    if prior is None:
        return None, None
    inverse, excess = np.zeros(len(free) + further), np.zeros(len(free) + further)
    columns = [free.index(name) for name in SCALES]
    inverse[columns] = (prior.pixel_mm * prior.error) ** -2.0
    excess[columns] = chain.pixel_mm - prior.pixel_mm
    return np.diag(inverse), excess


def sensor_error(points: ImagePoints, phantom: Phantom, chain: Chain) -> SensorError:
    """How residuals move with small turns of the sensor about the world's axes, rad, and with shifts, mm.

    An orientation sensor's inclination wanders alone: its heading hardly moves lines of a plane that is
    nearly level.
    """
    rows, _ = phantom.vanishing(points)
    in_world = (rows.reshape(-1, 3) @ chain.target_from_world.as_matrix()[:3, :3]).reshape(rows.shape)
    flat = np.column_stack([points.pixels * chain.pixel_mm, np.zeros(len(points))])
    if phantom.seen_as == "direction":
        along = np.einsum("nij,nj->ni", points.turns, chain.sensor_from_image.rotation.apply(flat))
        turned = np.cross(along[:, None], in_world)
        return SensorError(turned.reshape(-1, 3)[:, :2], (np.ones(2),))
    arm = np.einsum("nij,nj->ni", points.turns, chain.sensor_from_image.apply(flat))
    shifted = in_world @ shift_axes(points, phantom, chain)
    both = np.concatenate([np.cross(arm[:, None], in_world), shifted], axis=2)
    proportions = [np.repeat([1.0, np.rad2deg(mm)], 3) for mm in _PROPORTIONS_MM]
    return SensorError(
        both.reshape(-1, 6), [*proportions, _LATERAL] if phantom.kept_in_plane else proportions
    )


def shift_axes(points: ImagePoints, phantom: Phantom, chain: Chain) -> FloatArray:
    """Directions, in the world, of the sensor's shifts: columns, shape (n, 3, 3) or (3, 3).

    The world's own; but the image's where a hand keeps the target in it.
    """
    if not phantom.kept_in_plane:
        return np.eye(3)
    return np.asarray(points.turns @ chain.sensor_from_image.as_matrix()[:3, :3])


def _corrected(
    points: ImagePoints, phantom: Phantom, chain: Chain, sensor: FloatArray, image: FloatArray
) -> tuple[ImagePoints, FloatArray]:
    """Take expected errors out of poses and pixels; return also what that takes out of the residuals.

    Parameters
    ----------
    sensor : ndarray, shape (n r, k)
    image : ndarray, shape (n r,)
        See `attributed`.
    """
    rows, _ = phantom.vanishing(points)
    several = rows.shape[1]
    error = np.zeros((len(points), 6))
    error[:, : sensor.shape[1]] = sensor[::several]
    moved = points.world_from_sensor.as_matrix()
    moved[:, :3, :3] = Rotation.from_rotvec(-error[:, :3]).as_matrix() @ points.turns
    axes = shift_axes(points, phantom, chain)
    moved[:, :3, 3] -= np.squeeze(axes @ error[:, 3:, None], axis=2)
    poses = RigidTransform(moved, normalize=False)
    in_world = (rows.reshape(-1, 3) @ chain.target_from_world.as_matrix()[:3, :3]).reshape(rows.shape)
    in_image = in_world @ points.turns @ chain.sensor_from_image.as_matrix()[:3, :2]
    # The smallest displacement in the image, mm, that explains what is left to it.
    if several == 1:  # a batch of pseudo-inverses takes as long as all else
        square = np.maximum(np.sum(in_image**2, axis=2), np.finfo(float).tiny)
        moved_mm = in_image[:, 0] * (image[:, None] / square)
    else:
        moved_mm = np.einsum("nkr,nr->nk", np.linalg.pinv(in_image), image.reshape(-1, several))
    corrected = replace(points, world_from_sensor=poses, pixels=points.pixels - moved_mm / chain.pixel_mm)
    effect = sensor_error(corrected, phantom, chain).effects
    taken = np.einsum("mk,mk->m", effect, sensor) + np.einsum("nrk,nk->nr", in_image, moved_mm).ravel()
    return corrected, taken
