"""In-plane motion and correlations of one frame pair in NumPy, patch by patch: the twin of `match_pairs`."""

import numpy as np
import oracles

from speckle3d.core.leastsquares import MAD_TO_SIGMA, huber_weights
from speckle3d.matching.inplane import InPlaneSettings

LEAST = 0.05


def match(fixed, moving, patches, start, centre_mm, settings=None, echoes=None, wavenumber_per_mm=0.0):
    """Correlation of the patches and (x, y, roll) with its covariance."""
    s = settings or InPlaneSettings()
    at, spacing = patches.centre_mm - centre_mm[:2], patches.spacing_mm
    place = patches.first, patches.size
    motion, covariance, strain = np.array([start.x_mm, start.y_mm, start.roll_rad]), None, np.zeros(2)
    turn = np.array([[np.cos(motion[2]), -np.sin(motion[2])], [np.sin(motion[2]), np.cos(motion[2])]])
    predicted = (at - motion[:2]) @ turn - at
    for _ in range(2):
        lag = np.rint(predicted / spacing).astype(np.int64)
        rho = oracles.patch_correlations(fixed, moving, *place, lag, s.least_overlap, (1, 1))
        shift, weight = peaks(rho, lag, spacing)
        fitted = fit(shift, weight, at)
        if fitted is not None:
            motion, covariance, predicted, strain = fitted
        if np.array_equal(np.rint(predicted / spacing), lag):
            break
    if echoes is not None:
        lag = np.rint(predicted / spacing).astype(np.int64)
        ramp = wavenumber_per_mm * strain * spacing
        rho = oracles.patch_coherences(*echoes, *place, lag, ramp, s.least_overlap, (1, 1))
        centre = np.maximum(rho[:, 1:2, 1:2], LEAST)
        rho[:, ::2, ::2] = rho[:, ::2, 1:2] * rho[:, 1:2, ::2] / centre
    offset = np.clip(predicted / spacing - lag, -1.0, 1.0)
    return read_at(rho, offset), motion, covariance


def sound(rho):
    """Patches whose logarithms carry along both axes."""
    cross = np.concatenate([rho[:, 1, :], rho[:, ::2, 1]], axis=1)
    return np.nan_to_num(cross, nan=1.0).min(axis=1) > LEAST


def peaks(rho, lag, spacing):
    """Vertices of parabolas through ln(rho), or rho, and their weights (Walker & Trahey 1995)."""
    values = np.where(sound(rho)[:, None, None], np.log(np.maximum(rho, LEAST)), rho)
    offset = np.empty((len(rho), 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        for k, line in enumerate((values[:, :, 1], values[:, 1, :])):
            curvature = line[:, 0] - 2 * line[:, 1] + line[:, 2]
            offset[:, k] = np.where(curvature < 0, (line[:, 0] - line[:, 2]) / (2 * curvature), np.nan)
        peak = np.clip(rho[:, 1, 1], 0.0, 0.999)
        weight = np.where(np.abs(offset).max(axis=1) <= 1.5, peak**2 / (1 - peak**2), 0.0)
    return (lag + offset) * spacing, np.nan_to_num(weight)


def fit(shift, weight, at):
    """Motion, covariance, the field at all patches and its axial slopes; None if it is not determined."""
    good = weight > 0
    design = np.column_stack([np.ones(len(at)), at])
    if good.sum() < 6 or np.linalg.matrix_rank(design[good]) < 3:
        return None
    lateral, axial = (robust(design[good], shift[good, k], weight[good]) for k in range(2))
    covariance = np.zeros((3, 3))
    covariance[0, 0], covariance[1:, 1:] = lateral[1][0, 0], axial[1][:2, :2]
    roll = -axial[0][1]
    c, s = np.cos(roll), np.sin(roll)
    x, y = s * axial[0][0] - c * lateral[0][0], -s * lateral[0][0] - c * axial[0][0]
    field = np.column_stack([design @ lateral[0], design @ axial[0]])
    return np.array([x, y, roll]), covariance, field, axial[0][1:]


def robust(design, data, weight):
    """Five rounds of weighted least squares, Huber's weights at 1.5 deviations, by the upper median."""
    total = weight
    for _ in range(5):
        inverse = np.linalg.inv(design.T @ (design * total[:, None]))
        solution = inverse @ (design.T @ (total * data))
        size = np.abs(data - design @ solution) * np.sqrt(weight)
        scale = MAD_TO_SIGMA * np.sort(size)[size.size // 2] + 1e-12
        total = weight * huber_weights(size / scale, 1.5)
    return solution, inverse * scale**2


def read_at(rho, offset):
    """Correlation between lags: quadratics through ln(rho), or through rho."""
    t = offset[:, :, None]
    weights = np.concatenate([t * (t - 1) / 2, 1 - t * t, t * (t + 1) / 2], axis=2)
    log_value, value = (
        np.einsum("pi,pj,pij->p", weights[:, 0], weights[:, 1], each)
        for each in (np.log(np.maximum(rho, LEAST)), rho)
    )
    return np.where(sound(rho), np.exp(log_value), value)
