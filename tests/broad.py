"""BROAD trials and their score (Laidig et al. 2021, section 4): RMS over the moving part."""

import numpy as np
import scipy.io
from scipy.spatial.transform import Rotation

from xsens.logs.parts import nwu_from
from xsens.logs.samples import ImuLog

TRIALS = (
    "06_undisturbed_fast_rotation_A",
    "15_undisturbed_fast_translation_A",
    "28_disturbed_stationary_magnet_A",
)


def read_trial(folder, name):
    """The log, the optical orientation (NaN where unseen), and where the sensor moved."""
    held = scipy.io.loadmat(folder / f"{name}.mat")
    vectors = [np.ascontiguousarray(held[key], dtype=float) for key in ("imu_acc", "imu_gyr", "imu_mag")]
    time_s = np.arange(len(vectors[0])) / float(held["sampling_rate"].squeeze())
    return ImuLog(time_s, *vectors, source=name), held["opt_quat"], held["movement"].squeeze().astype(bool)


def east_first(rotations):
    """In the world of BROAD and VQF, x east, instead of this package's; quaternions, scalar first."""
    return (nwu_from("ENU").inv() * rotations).as_quat(scalar_first=True)


def errors_deg(found_wxyz, true_wxyz, moving, steady=False):
    """Total, heading and inclination error; `steady` leaves out a constant heading.

    BROAD leaves nothing out. Its cameras' north and a magnetometer's in one corner of the room need not be
    the same, so the error without a constant heading tells more of the motion.
    """
    seen = np.isfinite(true_wxyz).all(axis=1) & moving
    found, true = (Rotation.from_quat(q[seen], scalar_first=True) for q in (found_wxyz, true_wxyz))
    if steady:
        between = (found * true.inv()).as_quat(scalar_first=True)
        offset = np.angle(np.exp(2j * np.arctan2(between[:, 3], between[:, 0])).mean())
        found = Rotation.from_rotvec([0.0, 0.0, -offset]) * found
    w, x, y, z = np.abs((found * true.inv()).as_quat(scalar_first=True).T)
    total = 2 * np.arccos(np.clip(w, 0, 1))
    heading = 2 * np.arctan2(z, w)
    inclination = 2 * np.arcsin(np.clip(np.hypot(x, y), 0, 1))
    return np.rad2deg([np.sqrt(np.mean(each**2)) for each in (total, heading, inclination)])
