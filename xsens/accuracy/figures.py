"""Draw angles measured by the sensor beside the reference's along turns about one axis: worst and best.

Drawn without pyplot: no window system, no global state. Only this module of the room needs matplotlib.
"""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.text import printable
from xsens.accuracy.angles import ANGLES, PairErrors

OFF_AXIS_RAD = np.deg2rad(0.5)
"""Largest rotation of a frame about the two other axes: half of the sensor's claimed error at rest, no more
visible in the graphs than that error."""

FEWEST_FRAMES = 4
"""Fewer show no trend."""

_SHORTEST = 0.75
"""Shortest turn shown, as a fraction of the longest about its axis: short ones have the smallest errors."""


class Turn(NamedTuple):
    """Frames that differ in one angle only, in the order of that angle, with one calibration.

    The reference's angle from the first frame, shape (m,), starts at zero and grows; `error_rad` is that of
    the angle measured, likewise.
    """

    reference_rad: FloatArray
    error_rad: FloatArray


def turns_about(angle: str, errors: PairErrors) -> list[Turn]:
    """Turns about one axis, of at least `FEWEST_FRAMES` frames and nearly as long as the longest."""
    axis, turns, n = ANGLES.index(angle), list[Turn](), errors.frames
    reference, error = _between(errors.reference_rad.T, n), _between(errors.error_rad[..., axis], n)
    alone = (np.abs(np.delete(reference, axis, axis=0)) <= OFF_AXIS_RAD).all(axis=0)
    for start, angles in enumerate(reference[axis]):
        frames = np.flatnonzero(alone[start] & (angles >= 0))
        frames = frames[np.argsort(angles[frames], kind="stable")]
        if frames.size >= FEWEST_FRAMES and angles[frames[-1]] > 0:
            turns += [Turn(angles[frames], row) for row in error[:, start, frames]]
    longest = max((turn.reference_rad[-1] for turn in turns), default=0.0)
    return [turn for turn in turns if turn.reference_rad[-1] >= _SHORTEST * longest]


def _between(values: FloatArray, n: int) -> FloatArray:
    """Values of the pairs of n frames, last axis, from each frame to each, shape (..., n, n)."""
    square = np.zeros((*values.shape[:-1], n, n))
    first, second = np.triu_indices(n, 1)
    square[..., first, second] = values
    return square - square.swapaxes(-1, -2)


def figure_turns(errors: PairErrors, title: str = "") -> Figure:
    """Draw measured roll, yaw and tilt beside the reference's: worst examples left, best ones right.

    Parameters
    ----------
    errors : PairErrors
        Examples are chosen from all calibrations by their largest error.
    title : str
        Over the figure.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InsufficientDataError
        If no frames differ in one angle only.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 5.
    """
    turns_of = {angle: turns for angle in ANGLES if (turns := turns_about(angle, errors))}
    if not turns_of:
        raise InsufficientDataError(
            f"expected at least {FEWEST_FRAMES} frames that differ in one angle only, to within "
            f"{np.rad2deg(OFF_AXIS_RAD):g} degrees, got none: there is no turn to draw"
        )
    figure = Figure(figsize=(9.0, 2.8 * len(turns_of)), layout="constrained")
    panels = figure.subplots(len(turns_of), 2, squeeze=False)
    for row, (angle, turns) in zip(panels, turns_of.items(), strict=True):
        for axes, rank, choose in zip(row, ("worst", "best"), (max, min), strict=True):
            turn = choose(turns, key=lambda turn: np.abs(turn.error_rad).max())
            reference = np.rad2deg(turn.reference_rad)
            axes.plot(reference, color="black", label="reference")
            axes.plot(reference + np.rad2deg(turn.error_rad), "o--", label="sensor")
            axes.set_title(f"{rank} {angle}", fontsize="medium")
            axes.set(xlabel="orientation in the turn", ylabel=f"{angle} / degrees")
            axes.grid(visible=True)
    panels[0, 0].legend()
    figure.suptitle(printable(title), parse_math=False)
    return figure
