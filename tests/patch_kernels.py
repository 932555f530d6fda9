"""All patches of two frames correlated by the kernels that `match_pairs` calls patch by patch."""

from speckle3d.kernels.correlation import buffers, cohere_patch, correlate_patch, turns


def patch_correlations(fixed, moving, first, size, shift, least_overlap, out, corners=True):
    """Fill ``out[p]`` as `correlate_patch` does, patch by patch."""
    room = buffers(size, out.shape[1] // 2, out.shape[2] // 2)
    for p in range(first.shape[0]):
        correlate_patch(fixed, moving, first[p], size, shift[p], least_overlap, corners, room, out[p])


def patch_coherences(fixed, moving, first, size, shift, ramp_rad, least_overlap, out, corners=True):
    """Fill ``out[p]`` as `cohere_patch` does, patch by patch."""
    room = buffers(size, out.shape[1] // 2, out.shape[2] // 2)
    turn = turns(size, out.shape[2] // 2, ramp_rad)
    for p in range(first.shape[0]):
        cohere_patch(fixed, moving, first[p], size, shift[p], turn, least_overlap, corners, room, out[p])
