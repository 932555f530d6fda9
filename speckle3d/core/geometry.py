"""Frames of reference and angle conventions, on SciPy's ``Rotation`` and ``RigidTransform``.

The image frame P has its origin at the image's top left, x lateral, y axial (depth grows) and
z = x cross y, elevational. Tilt, yaw and roll are rotations about the image's x, y and z. A transform is
named by both of its ends, ``world_from_image``, so that neighbouring names match in every product.
Lengths are millimetres, angles radians.
"""

import warnings

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

RIGID_TOLERANCE = 1e-4
"""How far entries may be from the nearest rotation's, and |q| from one, in files (float32 safe)."""


def rotation_from_fixed_angles(alpha: npt.ArrayLike, beta: npt.ArrayLike, gamma: npt.ArrayLike) -> Rotation:
    """Rotation by x-y-z fixed angles, R = Rz(alpha) Ry(beta) Rx(gamma).

    Parameters
    ----------
    alpha, beta, gamma : array_like, shape (...,)
        Roll, yaw and tilt in radians.

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, section 2.
    """
    return Rotation.from_euler("ZYX", np.stack(np.broadcast_arrays(alpha, beta, gamma), axis=-1))


def roll_yaw_tilt(rotation: Rotation) -> FloatArray:
    """Angles about the image's z, y and x axes, the inverse of `rotation_from_fixed_angles`.

    Returns
    -------
    ndarray, shape (..., 3)
        Roll, yaw, tilt in radians; tilt is zero where yaw is a right angle, and roll and tilt are one.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Gimbal lock", UserWarning)
        return np.asarray(rotation.as_euler("ZYX"))


def relative_poses(world_from_image: RigidTransform) -> RigidTransform:
    """Pose of every frame seen from the frame before it: ``previous_from_image``, one fewer than given."""
    return world_from_image[:-1].inv() * world_from_image[1:]


def elevational_steps(world_from_image: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Signed travel of the image centre along the previous frame's z, shape (n - 1,), mm."""
    return np.asarray((relative_poses(world_from_image).apply(centre_mm) - centre_mm)[:, 2])


def mirrored(world_from_image: RigidTransform) -> RigidTransform:
    """Motion mirrored in the first image's plane: elevation, tilt and yaw change sign.

    Images cannot tell a sweep from its mirror image, since distances from decorrelation have no sign. The
    world must be the frame of the first image, or parallel to it.
    """
    flip = np.diag([1.0, 1.0, -1.0, 1.0])
    return RigidTransform.from_matrix(flip @ world_from_image.as_matrix() @ flip)


def skew(vectors: FloatArray) -> FloatArray:
    """Matrices of the cross product ``v x``, shape (..., 3) to (..., 3, 3)."""
    return np.cross(np.eye(3), vectors[..., None, :])


def nearest_rotation(matrices: npt.ArrayLike) -> FloatArray:
    """Rotation matrices nearest to given ones in the sum of squared differences.

    Parameters
    ----------
    matrices : array_like, shape (..., 3, 3) or (..., 3, 2)
        Roughly rotations; or their first two columns, the x and y axes, of which the longer counts more.

    Returns
    -------
    ndarray, shape (..., 3, 3)

    References
    ----------
    .. [1] K. S. Arun, T. S. Huang and S. D. Blostein, "Least-squares fitting of two 3-D point sets", IEEE
       Trans. Pattern Anal. Mach. Intell., 1987.

    Examples
    --------
    >>> import numpy as np
    >>> nearest_rotation(1.001 * np.eye(3)).round(6).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    rough = np.asarray(matrices, dtype=float)
    rough = np.concatenate([rough, np.zeros((*rough.shape[:-1], 3 - rough.shape[-1]))], axis=-1)
    left, _, right = np.linalg.svd(rough)
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


def rotations_from_quaternions(wxyz: npt.ArrayLike, where: str) -> Rotation:
    """Validate scalar-first unit quaternions, shape (m, 4), read from `where`.

    Raises
    ------
    InvalidInputError
        Naming `where` and the first bad index.
    """
    q = require_rows(wxyz, (4,), where)
    # Clipped, so that no square overflows.
    for first in np.flatnonzero(np.abs(np.linalg.norm(q.clip(-2, 2), axis=1) - 1.0) > RIGID_TOLERANCE):
        raise InvalidInputError(f"{where}[{first}]: expected a unit quaternion, got {q[first]}")
    return Rotation.from_quat(q, scalar_first=True)


def transforms_from_matrices(matrices: npt.ArrayLike, where: str) -> RigidTransform:
    """Validate rigid 4x4 matrices, shape (m, 4, 4), read from `where`.

    Raises
    ------
    InvalidInputError
        Naming `where` and the first index that is not a proper rotation with translation.
    """
    m = require_rows(matrices, (4, 4), where)
    rotation = Rotation.from_matrix(nearest_rotation(m[:, :3, :3]))
    rigid = RigidTransform.from_components(m[:, :3, 3], rotation)
    for first in np.flatnonzero(np.abs(m - rigid.as_matrix()).max(axis=(1, 2)) > RIGID_TOLERANCE):
        raise InvalidInputError(f"{where}[{first}]: expected a rigid 4x4 matrix, got another")
    return rigid


def rigid(samples: RigidTransform | Rotation) -> RigidTransform:
    """Poses as rigid transforms; an orientation sensor's are all at the origin."""
    return samples if isinstance(samples, RigidTransform) else RigidTransform.from_rotation(samples)


def require_finite(values: npt.NDArray[np.floating], where: str) -> None:
    """Raise `InvalidInputError` naming the first entry of `values` that is NaN or infinite."""
    for index in np.argwhere(~np.isfinite(values)).tolist():
        raise InvalidInputError(f"{where}{index}: expected a finite value, got {values.item(*index)}")


def require_increasing(times_s: npt.ArrayLike, where: str) -> FloatArray:
    """Return `times_s`, shape (m,), if finite and strictly increasing; else raise `InvalidInputError`."""
    t = require_rows(times_s, (), where)
    for i in np.flatnonzero(t[1:] <= t[:-1]) + 1:
        raise InvalidInputError(
            f"{where}[{i}]: expected strictly increasing times, got {t[i]:.6f} s after {t[i - 1]:.6f} s"
        )
    return t


def require_rows(values: npt.ArrayLike, row: tuple[int, ...], where: str) -> FloatArray:
    """Return finite values of shape (m, *row) as an array of floats; else raise `InvalidInputError`."""
    rows = np.asarray(values, dtype=float)
    if not rows.ndim or rows.shape[1:] != row:
        raise InvalidInputError(f"{where}: expected shape {('m', *row)}, got {rows.shape}")
    require_finite(rows, where)
    return rows
