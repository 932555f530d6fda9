"""BROAD trials and their score (Laidig et al. 2021, section 4), for our methods and for VQF itself."""

from typing import NamedTuple

import numpy as np
import scipy.io
from scipy.spatial.transform import Rotation
from vqf import VQF, offlineVQF

from xsens.fusion.orient import orient
from xsens.logs.samples import ImuLog
from xsens.logs.worlds import nwu_from

ONLINE = ("VQF on-line", "filter")
OFFLINE = ("VQF off-line", "smoother")
"""VQF itself, as its authors publish it, and ours."""


class Estimate(NamedTuple):
    """Orientation in the world of BROAD and VQF, x east; sigma about its axes, NaN if not claimed."""

    wxyz: np.ndarray
    sigma_rad: np.ndarray


def trials_in(folder):
    """Names of the trials in a folder."""
    return sorted(path.stem for path in folder.glob("*.mat"))


def read_trial(folder, name):
    """The log, the optical orientation (NaN where unseen), and where the sensor moved."""
    held = scipy.io.loadmat(folder / f"{name}.mat")
    vectors = [np.ascontiguousarray(held[key], dtype=float) for key in ("imu_acc", "imu_gyr", "imu_mag")]
    time_s = np.arange(len(vectors[0])) / float(held["sampling_rate"].squeeze())
    return ImuLog(time_s, *vectors, source=name), held["opt_quat"], held["movement"].squeeze().astype(bool)


def estimate(log, method, settings=None):
    """Orientation by a method of `ONLINE` or `OFFLINE`, or any that `orient` knows."""
    if method.startswith("VQF"):
        return Estimate(by_vqf(log, method), np.full((len(log), 3), np.nan))
    found = orient(log, settings, method)
    north, west, up = found.standard_deviation_rad.T
    return Estimate(east_first(found.rotations.world_from_sensor), np.column_stack([west, north, up]))


def by_vqf(log, method):
    """Quaternions of VQF with its default parameters; it leaves a field of zeros out."""
    field = np.where(np.isfinite(log.magnetometer_au), log.magnetometer_au, 0.0)
    readings = [np.ascontiguousarray(each) for each in (log.gyroscope_rad_s, log.accelerometer_m_s2, field)]
    if method == "VQF on-line":
        return VQF(1.0 / log.rate_hz).updateBatch(*readings)["quat9D"]
    return offlineVQF(*readings, 1.0 / log.rate_hz)["quat9D"]


def east_first(rotations):
    """In the world of BROAD and VQF, x east, instead of this package's; quaternions, scalar first."""
    return (nwu_from("ENU").inv() * rotations).as_quat(scalar_first=True)


class Errors(NamedTuple):
    """Errors of the samples that count, rad: magnitude of the whole, about up, about x and y."""

    total: np.ndarray
    heading: np.ndarray
    inclination_xy: np.ndarray


def errors_rad(found_wxyz, true_wxyz, counts, steady=False):
    """Errors of the samples that count; `steady` leaves out a constant heading.

    BROAD leaves nothing out. Its cameras' north and a magnetometer's in one corner of the room need not be
    the same, so the error without a constant heading tells more of the motion.
    """
    found, true = (Rotation.from_quat(q[counts], scalar_first=True) for q in (found_wxyz, true_wxyz))
    if steady:
        between = (found * true.inv()).as_quat(scalar_first=True)
        offset = np.angle(np.exp(2j * np.arctan2(between[:, 3], between[:, 0])).mean())
        found = Rotation.from_rotvec([0.0, 0.0, -offset]) * found
    between = found * true.inv()
    w, _, _, z = between.as_quat(scalar_first=True, canonical=True).T
    heading = 2 * np.arctan2(z, w)
    # The turn about a horizontal axis that is left when the turn about up is taken away.
    level = Rotation.from_rotvec(np.outer(heading, [0.0, 0.0, -1.0])) * between
    return Errors(between.magnitude(), heading, level.as_rotvec()[:, :2])


def counting(true_wxyz, moving):
    """Samples that count: moving, and seen by the cameras."""
    return np.isfinite(true_wxyz).all(axis=1) & moving


def rms_deg(values_rad):
    return float(np.rad2deg(np.sqrt(np.mean(np.square(values_rad)))))


def errors_deg(found_wxyz, true_wxyz, moving, steady=False):
    """RMS of total, heading and inclination error; `steady` leaves out a constant heading."""
    found = errors_rad(found_wxyz, true_wxyz, counting(true_wxyz, moving), steady)
    inclination = np.linalg.norm(found.inclination_xy, axis=1)
    return np.array([rms_deg(each) for each in (found.total, found.heading, inclination)])


class Coverage(NamedTuple):
    """Share of errors within one claimed sigma, and RMS error over RMS claimed sigma."""

    heading_share: float
    heading_ratio: float
    inclination_share: float
    inclination_ratio: float


def coverage(found, true_wxyz, moving, steady=False):
    """How the claimed sigma fits the errors; of inclination, about x and y each with its own."""
    counts = counting(true_wxyz, moving)
    errors, sigma = errors_rad(found.wxyz, true_wxyz, counts, steady), found.sigma_rad[counts]
    parts = []
    for error, claimed in ((errors.heading, sigma[:, 2]), (errors.inclination_xy, sigma[:, :2])):
        parts += [float(np.mean(np.abs(error) < claimed)), rms_deg(error) / rms_deg(claimed)]
    return Coverage(*parts)
