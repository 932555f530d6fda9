"""Draw angles measured by the sensor beside the reference's along turns about one axis: worst and best.

Drawn without pyplot: no window system, no global state. Only this module of the room needs matplotlib.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.printable import printable
from xsens.accuracy.angles import ANGLES, PairErrors

OFF_AXIS_RAD = np.deg2rad(0.5)
"""Largest rotation of a frame about the two other axes: half of the sensor's claimed error at rest, no more
visible in the graphs than that error."""

FEWEST_FRAMES = 4
"""Fewer show no trend."""

_SHORTEST = 0.75
"""Shortest turn shown, as a fraction of the longest about its axis: short ones have the smallest errors."""

_COLOURS = {"roll": "#009E73", "yaw": "#D55E00", "tilt": "#0072B2"}


@dataclass(frozen=True)
class Turn:
    """Frames that differ in one angle only, in the order of that angle.

    Attributes
    ----------
    experiment, angle : str
    frame : ndarray of int, shape (m,)
    reference_rad : ndarray, shape (m,)
        Angle from the first frame; it starts at zero and grows.
    measured_rad : ndarray, shape (k, m)
        Measured angle by every calibration.
    """

    experiment: str
    angle: str
    frame: IntArray
    reference_rad: FloatArray
    measured_rad: FloatArray

    @property
    def drift_rad(self) -> FloatArray:
        """Largest error along the turn by every calibration, shape (k,)."""
        return np.asarray(np.abs(self.measured_rad - self.reference_rad).max(axis=1))


def turns_about(angle: str, experiments: Mapping[str, PairErrors]) -> list[Turn]:
    """Turns about one axis, of at least `FEWEST_FRAMES` frames and nearly as long as the longest."""
    axis = ANGLES.index(angle)
    found = [turn for name, errors in experiments.items() for turn in _turns(name, errors, axis)]
    longest = max((turn.reference_rad[-1] for turn in found), default=0.0)
    return [turn for turn in found if turn.reference_rad[-1] >= _SHORTEST * longest]


def figure_turns(experiments: Mapping[str, PairErrors], title: str = "") -> Figure:
    """Draw measured roll, yaw and tilt beside the reference's: worst examples left, best ones right.

    Parameters
    ----------
    experiments : mapping of str to PairErrors
        Errors by name; examples are chosen from all experiments and calibrations by their largest error.

    Raises
    ------
    InsufficientDataError
        If no frames differ in one angle only.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 5.
    """
    turns = {angle: turns_about(angle, experiments) for angle in ANGLES}
    drawn = [angle for angle in ANGLES if turns[angle]]
    if not drawn:
        raise InsufficientDataError(
            f"expected at least {FEWEST_FRAMES} frames that differ in one angle only, to within "
            f"{np.rad2deg(OFF_AXIS_RAD):g} degrees, got none: there is no turn to draw"
        )
    figure = Figure(figsize=(9.0, 2.8 * len(drawn)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(drawn), 2, squeeze=False)
    for row, angle in zip(panels, drawn, strict=True):
        _draw(row[0], max(turns[angle], key=lambda turn: float(turn.drift_rad.max())), worst=True)
        _draw(row[1], min(turns[angle], key=lambda turn: float(turn.drift_rad.min())), worst=False)
    panels[0, 0].legend(frameon=False, fontsize="small")
    figure.suptitle(printable(title), parse_math=False)
    return figure


def _turns(name: str, errors: PairErrors, axis: int) -> Iterator[Turn]:
    for start in range(errors.frames):
        frame, reference, measured = _seen_from(start, errors)
        off_axis = np.delete(reference, axis, axis=1)
        kept = np.flatnonzero((np.abs(off_axis) <= OFF_AXIS_RAD).all(axis=1) & (reference[:, axis] >= 0))
        kept = kept[np.argsort(reference[kept, axis], kind="stable")]
        if kept.size >= FEWEST_FRAMES and reference[kept[-1], axis] > 0:
            yield Turn(name, ANGLES[axis], frame[kept], reference[kept, axis], measured[:, kept, axis])


def _seen_from(start: int, errors: PairErrors) -> tuple[IntArray, FloatArray, FloatArray]:
    """Frames, reference and measured angles from one frame to itself and all others."""
    n = errors.frames
    others = np.delete(np.arange(n), start)
    low, high = np.minimum(start, others), np.maximum(start, others)
    pairs = np.concatenate([[0], low * (2 * n - low - 1) // 2 + high - low - 1])
    frame = np.concatenate([[start], others])
    sign = np.sign(frame - start).astype(float)
    reference = sign[:, None] * errors.reference_rad[pairs]
    return frame, reference, reference + sign[:, None] * errors.error_rad[:, pairs]


def _draw(axes: Axes, turn: Turn, worst: bool) -> None:
    calibration = int(turn.drift_rad.argmax() if worst else turn.drift_rad.argmin())
    measured = np.rad2deg(turn.measured_rad[calibration])
    at = np.arange(turn.frame.size)
    axes.plot(at, np.rad2deg(turn.reference_rad), color="black", linewidth=2.2, alpha=0.55, label="reference")
    axes.plot(at, measured, "o--", color=_COLOURS[turn.angle], markersize=4, linewidth=1.3, label="sensor")
    which = "worst" if worst else "best"
    axes.set_title(
        f"{which} {turn.angle}: {turn.experiment}, calibration {calibration + 1}",
        fontsize="medium",
        parse_math=False,
    )
    axes.set_xlabel("orientation in the turn")
    axes.set_ylabel(f"{turn.angle} / degrees")
    axes.grid(visible=True, alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
