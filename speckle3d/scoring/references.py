"""Reference of a reconstruction: the simulation's truth, or the position sensor.

`sweep_curves` accumulates the motion of both, frame by frame, as figures show them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.sweep import Sweep
from speckle3d.scoring.lengths import (
    END_FRAMES,
    TRACKER,
    ModeError,
    compare_modes,
    part_lengths,
    read_end,
    sum_motion,
)

REFERENCES = {"tracker": "a calibrated tracker over the frames", "truth": "true poses in /truth"}
"""What a sweep may be compared with, and what it needs for that."""
_UNITS = np.array([[1.0], *[[180.0 / np.pi]] * 3])
"""mm per mm and degrees per radian, of length and three turns."""


@dataclass(frozen=True)
class Reference:
    """Poses that modes are compared with.

    Attributes
    ----------
    name : str
        "tracker", "truth", or a mode that others are compared with.
    world_from_image : RigidTransform, length k
        At the covered frames.
    covered : ndarray of bool, shape (n,)
        Which of the sweep's n frames have a reference; k of them.
    """

    name: str
    world_from_image: RigidTransform
    covered: BoolArray

    @classmethod
    def over_all(cls, name: str, world_from_image: RigidTransform) -> Reference:
        """A reference at every frame."""
        return cls(name, world_from_image, np.ones(len(world_from_image), dtype=bool))

    @property
    def end_frames(self) -> int:
        """Most frames of the line that reads an end of a part: 1 for any but a tracker, which jitters."""
        return END_FRAMES if self.name == TRACKER else 1


@dataclass(frozen=True)
class SweepCurves:
    """Accumulated length (mm), tilt, yaw and roll (degrees) over the frames.

    Attributes
    ----------
    modes : dict of str to ndarray, shape (4, n)
    reference : ndarray, shape (4, n), or None
        NaN at frames without one.
    reference_name : str
    half_width : ndarray, shape (4, n), or None
        Of the 95 % interval of mode `image`.
    """

    modes: Mapping[str, FloatArray]
    reference: FloatArray | None = None
    reference_name: str = "none"
    half_width: FloatArray | None = None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(next(iter(self.modes.values())).shape[1])


def find_reference(sweep: Sweep, name: str | None = None) -> Reference | None:
    """Poses to compare a sweep's modes with: by default the truth if stored, else the tracker, else None.

    Parameters
    ----------
    sweep : Sweep
    name : {"tracker", "truth"}, optional

    Raises
    ------
    InvalidInputError
        If `name` is neither.
    InsufficientDataError
        If the sweep does not have these poses.
    """
    if name not in (None, *REFERENCES):
        raise InvalidInputError(f"expected {' or '.join(REFERENCES)}, got {name!r}")
    if sweep.truth is not None and name != "tracker":
        return Reference.over_all("truth", sweep.truth)
    reference = None if name == "truth" else _of_tracker(sweep)
    if name and reference is None:
        raise InsufficientDataError(f"{sweep.name}: expected {REFERENCES[name]}, got none")
    return reference


def tracker_alone(sweep: Sweep) -> RigidTransform | None:
    """Poses by the position sensor alone, no images; None unless it is calibrated and covers every frame."""
    reference = _of_tracker(sweep)
    return reference.world_from_image if reference and reference.covered.all() else None


def _of_tracker(sweep: Sweep) -> Reference | None:
    tracker, times = sweep.tracker, sweep.frame_time_s
    if tracker is None or tracker.sensor_from_image is None or (mask := tracker.covers(times)).sum() < 2:
        return None
    return Reference(TRACKER, tracker.world_from_image(times[mask]), mask)


def sweep_curves(
    poses: Mapping[str, RigidTransform],
    centre_mm: FloatArray,
    reference: Reference | None = None,
    covariance: FloatArray | None = None,
) -> SweepCurves:
    """Accumulate the motion of every mode and of the reference.

    Parameters
    ----------
    poses : mapping of str to RigidTransform, length n
        ``world_from_image`` by mode; that of the reference's name is left out.
    centre_mm : ndarray, shape (3,)
        Image centre in the image frame.
    reference : Reference, optional
        A tracker's curves begin where the line through its first readings does (`lengths.read_end`), not at
        the first reading, whose jitter they would carry throughout.
    covariance : ndarray, shape (n, 6, 6), optional
        Of the poses of mode `image`: (x, y, z) in mm and (tilt, yaw, roll) in radians.
    """
    modes = {
        mode: _curves(path, centre_mm, END_FRAMES if mode == TRACKER else 1)
        for mode, path in _estimates(poses, reference).items()
    }
    half_width = None
    if covariance is not None and "image" in modes:
        half_width = 1.96 * _UNITS * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T[2:]
    if reference is None:
        return SweepCurves(modes, half_width=half_width)
    curves = np.full((4, reference.covered.size), np.nan)
    curves[:, reference.covered] = _curves(reference.world_from_image, centre_mm, reference.end_frames)
    return SweepCurves(modes, curves, reference.name, half_width)


def error_rows(
    poses: Mapping[str, RigidTransform],
    reference: Reference | None,
    centre_mm: FloatArray,
    jitter_mm: float | None = None,
) -> list[ModeError]:
    """Errors of every mode by part; lengths alone of the tracker as the reference, and without a reference.

    Parameters
    ----------
    poses : mapping of str to RigidTransform, length n
        By mode; the reference may be among them.
    jitter_mm : float, optional
        As for `compare_modes`.
    """
    estimates = _estimates(poses, reference)
    if reference is None or not estimates:
        parts, lengths = part_lengths(poses, centre_mm)
        return [
            ModeError(part.name, mode, part.last - part.first + 1, estimate_mm=float(lengths[mode][k]))
            for k, part in enumerate(parts)
            for mode in poses
        ]
    true = reference.world_from_image
    rows = compare_modes(estimates, true, centre_mm, reference.covered, reference.end_frames, jitter_mm)
    if reference.name == TRACKER:
        for last in {row.part: row for row in rows}.values():
            length, sigma = last.reference_mm, last.reference_sigma_mm
            row = ModeError(last.part, TRACKER, last.frames, length, length)
            rows.insert(rows.index(last) + 1, replace(row, reference_sigma_mm=sigma, sigma_mm=sigma))
    return rows


def _estimates(
    poses: Mapping[str, RigidTransform], reference: Reference | None
) -> Mapping[str, RigidTransform]:
    """Poses of every mode but that of the reference's name."""
    return {mode: path for mode, path in poses.items() if reference is None or mode != reference.name}


def _curves(poses: RigidTransform, centre_mm: FloatArray, end_frames: int) -> FloatArray:
    """Length (mm), tilt, yaw and roll (degrees), shape (4, n), zero where the first end is read."""
    curves = _UNITS * np.stack(sum_motion(poses, centre_mm))
    curves -= [[read_end(curve[::-1], end_frames)] for curve in curves]
    return curves
