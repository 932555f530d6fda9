"""BROAD trials and their score (Laidig et al. 2021, section 4), for our methods and for VQF itself."""

from typing import NamedTuple

import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation

from xsens.fusion.orient import orient
from xsens.logs.assembly import WORLDS
from xsens.logs.samples import ImuLog

vqf = pytest.importorskip("vqf")
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
    trial = scipy.io.loadmat(folder / f"{name}.mat")
    vectors = [np.ascontiguousarray(trial[key], dtype=float) for key in ("imu_acc", "imu_gyr", "imu_mag")]
    time_s = np.arange(len(vectors[0])) / float(trial["sampling_rate"].squeeze())
    moving = trial["movement"].squeeze().astype(bool)
    return ImuLog(time_s, *vectors, source=name), trial["opt_quat"], moving


def estimate(log, method):
    """Orientation by a method of `ONLINE` or `OFFLINE`, or any that `orient` knows."""
    if method.startswith("VQF"):
        return Estimate(by_vqf(log, method), np.full((len(log), 3), np.nan))
    orientation = orient(log, method=method)
    north, west, up = orientation.standard_deviation_rad.T
    return Estimate(east_first(orientation.rotations.world_from_sensor), np.column_stack([west, north, up]))


def by_vqf(log, method):
    """Quaternions of VQF with its default parameters; it leaves a field of zeros out."""
    field = np.where(np.isfinite(log.magnetometer_au), log.magnetometer_au, 0.0)
    readings = [np.ascontiguousarray(v) for v in (log.gyroscope_rad_s, log.accelerometer_m_s2, field)]
    if method == "VQF on-line":
        return vqf.VQF(1.0 / log.rate_hz).updateBatch(*readings)["quat9D"]
    return vqf.offlineVQF(*readings, 1.0 / log.rate_hz)["quat9D"]


def east_first(rotations):
    """In the world of BROAD and VQF, x east, instead of this package's; quaternions, scalar first."""
    return (WORLDS["ENU"].inv() * rotations).as_quat(scalar_first=True)


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
    rotation, true = (Rotation.from_quat(q[counts], scalar_first=True) for q in (found_wxyz, true_wxyz))
    if steady:
        between = (rotation * true.inv()).as_quat(scalar_first=True)
        offset = np.angle(np.exp(2j * np.arctan2(between[:, 3], between[:, 0])).mean())
        rotation = Rotation.from_rotvec([0.0, 0.0, -offset]) * rotation
    between = rotation * true.inv()
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
    errors = errors_rad(found_wxyz, true_wxyz, counting(true_wxyz, moving), steady)
    inclination = np.linalg.norm(errors.inclination_xy, axis=1)
    return np.array([rms_deg(e) for e in (errors.total, errors.heading, inclination)])


def coverage(orientation, true_wxyz, moving, steady=False):
    """Share of errors within one claimed sigma, RMS error over RMS sigma: of heading, then inclination."""
    counts = counting(true_wxyz, moving)
    errors, sigmas = errors_rad(orientation.wxyz, true_wxyz, counts, steady), orientation.sigma_rad[counts]
    parts = []
    for error, sigma in ((errors.heading, sigmas[:, 2]), (errors.inclination_xy, sigmas[:, :2])):
        parts += [float(np.mean(np.abs(error) < sigma)), rms_deg(error) / rms_deg(sigma)]
    return parts
