"""Kernels of single patches, called for all patches of a pair."""

from numba import njit

from speckle3d.kernels.correlation import cohere_patch, common_window, correlate_patch, phase_ramp


@njit
def patch_correlations(fixed, moving, first, size, shift, least_overlap, out):
    """Fill ``out[p]``, of the five lags, with Pearson's coefficients."""
    for p in range(len(first)):
        corner, lag = (first[p, 0], first[p, 1]), (shift[p, 0], shift[p, 1])
        window = common_window(corner, (size[0], size[1]), fixed.shape, lag, least_overlap)
        correlate_patch(fixed, moving, window, lag, out[p])


@njit
def patch_coherences(fixed, moving, first, size, shift, ramp_rad, least_overlap, out):
    """Fill ``out[p]``, of the five lags, with squared coherences."""
    turn = phase_ramp((size[0], size[1]), ramp_rad[0], ramp_rad[1])
    for p in range(len(first)):
        corner, lag = (first[p, 0], first[p, 1]), (shift[p, 0], shift[p, 1])
        window = common_window(corner, (size[0], size[1]), fixed.shape[1:], lag, least_overlap)
        cohere_patch(fixed, moving, turn, window, lag, out[p])
