"""Echoes that stay where they are in the image while the probe moves: reverberation, side lobes, electronics.

Speckle of places a beam's width and more apart has nothing in common, so that the product of two such frames'
echoes, sample by sample and without looking for in-plane motion, averages to zero. What is added to every
frame alike does not: the product's mean is its share of the power. The tissue's own structure moves in the
image as the hand wanders, and a quarter of a wavelength in depth turns its phase round.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.sweep import Sweep, read_frame
from speckle3d.core.threads import ahead
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.patches import PatchGrid


def standing_share(sweep: Sweep, matcher: FrameMatcher, frames: Sequence[int]) -> FloatArray:
    """Share of each patch's power that is the same in all of `frames`: median over their pairs.

    Parameters
    ----------
    frames : sequence of int
        At least two, far apart, read anew and all held at once. The median lets some of them see what
        others do, as on the way back.

    Returns
    -------
    ndarray, shape (p,)
        Of power, or with images of intensity of its variation; of either sign and about zero where nothing
        stays. NaN where there is no echo.
    """

    def look(frame: int) -> Float32Array:
        return _normalised(*matcher.equalised(matcher.echo(read_frame(sweep.frames, frame))), matcher.patches)

    echoes = list(ahead(look, frames))
    shared = [np.einsum("pk,pk->p", a, b) for a, b in combinations(echoes, 2)]
    return np.asarray(np.median(shared, axis=0), dtype=float)


def _normalised(image: Float32Array, echo: Float32Array | None, patches: PatchGrid) -> Float32Array:
    """Samples of every patch, of unit energy in all, shape (p, k); NaN where there is no echo."""
    parts = image[None] if echo is None else echo
    wide, high = patches.size
    tiles = np.stack([parts[:, v : v + wide, s : s + high].ravel() for v, s in patches.first])
    if echo is None:
        tiles -= tiles.mean(axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(tiles / np.linalg.norm(tiles, axis=1, keepdims=True), dtype=np.float32)
