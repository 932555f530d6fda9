"""VQF (Laidig and Seel, Information Fusion 91, 2023) as an engine beside the filter of this package.

VQF wants an even clock, a field at every sample, and gives no standard deviation of the orientation. Here its
samples are brought to an even clock, fields between those that came are interpolated, and what this package's
own engine claims, and how far VQF is from it, become VQF's deviation.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.fusion.readings import Estimate, Samples, turn_about_up


def by_vqf(stretch: Samples, claims: Estimate, offline: bool, magnetic: bool) -> Estimate:
    """Orientation of a stretch by VQF.

    Parameters
    ----------
    stretch : Samples
    own : Estimate
        The same by this package's engine: its variances, plus the squared distance of VQF from it about each
        of the world's axes, are VQF's variances.
    offline : bool
        Use later readings as well.
    magnetic : bool
        Let the magnetic field tell the heading.

    Raises
    ------
    InvalidInputError
        If VQF is not installed.
    """
    try:
        import vqf
    except ImportError as error:
        raise InvalidInputError(
            "the methods vqf and vqf-online need the package vqf, got none installed: pip install vqf, "
            "which may need a C++ compiler, or choose smoother or filter"
        ) from error
    magnetic = magnetic and bool(np.isfinite(stretch.field_au[:, 0]).any())
    time_s = np.cumsum(stretch.step_s)
    step_s = float(stretch.step_s.mean())
    place = (time_s - time_s[0]) / step_s
    grid = np.arange(max(round(float(place[-1])), 1) + 1.0)
    # A gyroscope's reading is the mean rate since the one before, here too: turns stay what they were.
    angle = np.cumsum(stretch.rate_rad_s * np.diff(place, prepend=0.0)[:, None], axis=0)
    rate = np.diff(_at(grid, place, angle), axis=0, prepend=0.0)
    rate[0] = stretch.rate_rad_s[0]
    force = _at(grid, place, stretch.force_m_s2)
    field = _at(grid, place, stretch.field_au) if magnetic else None
    find = vqf.offlineVQF if offline else vqf.VQF(step_s).updateBatch
    estimate = find(rate, force, field, *([step_s] if offline else []))
    rotations = Rotation.from_quat(estimate["quat9D" if magnetic else "quat6D"], scalar_first=True)
    xyzw = Slerp(grid, rotations)(np.minimum(place, grid[-1])).as_quat()
    north_rad = -0.5 * np.pi  # from VQF's world, x east
    if not magnetic:  # about up as the other engine begins
        first = Rotation.from_quat(claims.xyzw[0]) * Rotation.from_quat(xyzw[0]).inv()
        north_rad = 2.0 * float(np.arctan2(*first.as_quat()[2:]))
    xyzw = turn_about_up(north_rad, xyzw)
    difference = Rotation.from_quat(xyzw) * Rotation.from_quat(claims.xyzw).inv()
    at = np.minimum(np.rint(place).astype(np.int64), len(grid) - 1)
    disturbance = estimate["magDistDetected"][at] if magnetic else np.zeros(len(stretch), dtype=bool)
    return replace(
        claims,
        xyzw=xyzw,
        standard_deviation_rad=np.minimum(
            np.hypot(claims.standard_deviation_rad, difference.as_rotvec()), np.pi
        ),
        gyro_bias_rad_s=estimate["bias"][at],
        disturbed=disturbance,
        resting=estimate["restDetected"][at],
    )


def _at(places: FloatArray, grid: FloatArray, values: FloatArray) -> FloatArray:
    """Finite rows interpolated at places, from those at known ones."""
    rows = np.isfinite(values[:, 0])
    return np.column_stack([np.interp(places, grid[rows], column[rows]) for column in values.T])
