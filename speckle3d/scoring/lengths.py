"""Errors of length, tilt, yaw and roll of a reconstruction against a reference, part by part of the sweep.

*Length* is the accumulated elevational travel of the image centre: every frame's centre, seen from the frame
before it, moves by a signed z; length is the running sum. Tilt, yaw and roll are the running sums of the
same relative poses' angles. They need no common world, so a reconstruction without any sensor can be
compared, and they are the axes of figure 6 and of tables 3 and 4 of Housden et al. 2008.

**How an end is read** (`read_end`), the same for every mode and for the reference: off a robust line through
the frames there, at most a tenth of the part and at most `END_FRAMES`, *at* the end frame; against an exact
reference, the end frame as it is. Mode `tracker`, the position sensor alone, is read off lines always, so
that it has one length. Steps are signed, so of a tracker's jitter all but that of the two ends cancels, and
the lines average that. No number of the reference depends on an estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.geometry import relative_poses, roll_yaw_tilt
from speckle3d.core.leastsquares import robust_sigma

TRACKER = "tracker"
"""Mode of the position sensor alone: no images, no correction."""

JITTER_FRAMES = 9
"""Frames over which a sensor's jitter is averaged to find turning points: a third of a second."""

HYSTERESIS_MM = 0.5
"""How far the probe must come back for a turn to count."""

END_FRAMES = 25
"""Most frames of the line that reads an end. On 60 simulated hand sweeps of 400 frames and 20 mm, with a
tracker's 0.15 mm and 0.1 degrees per axis, lines of at most 1, 9, 25 and 51 frames (and a tenth of the sweep)
leave 0.34, 0.14, 0.09 and 0.13 mm RMS of error in the tracker's own length."""

_LINE_EXCESS = 1.25
"""Variance of a Theil-Sen line's end over that of least squares in white noise: 1.13 to 1.25 for 3 to 25
samples, in 20,000 trials each."""


class MotionSums(NamedTuple):
    """Motion summed from the first frame, all of shape (n,), zero at frame 0."""

    length_mm: FloatArray
    tilt_rad: FloatArray
    yaw_rad: FloatArray
    roll_rad: FloatArray


@dataclass(frozen=True)
class Part:
    """Monotone part of a sweep; neighbouring parts share their turning frame."""

    name: str
    first: int
    last: int


@dataclass(frozen=True)
class ModeError:
    """Error of one drift-correction mode in one part of a sweep.

    Errors are estimate minus reference; that of length is positive where the estimate is too long,
    whichever way the probe moved, and its percentage is of the reference's length in that part.

    Attributes
    ----------
    part : str
        "f" forward, "r" back, numbered where there are several; "all" of a sweep that has no reference and
        does not turn round.
    mode : str
    frames : int
        Of the part.
    reference_mm, estimate_mm : float
        Length by the reference and by this mode.
    length_error_mm, length_error_percent : float
    tilt_error_deg, yaw_error_deg, roll_error_deg : float
        Of the turn over the part, about the image's x, y and z.
    reference_sigma_mm : float
        Standard deviation of the reference's length by its own jitter; 0 if it is exact. What a tracker's
        calibration adds is not in it.
    sigma_mm : float
        Standard deviation of `estimate_mm`: of mode `tracker` by its jitter, of others as they claim it.
    """

    part: str
    mode: str
    frames: int
    reference_mm: float = np.nan
    estimate_mm: float = np.nan
    length_error_mm: float = np.nan
    length_error_percent: float = np.nan
    tilt_error_deg: float = np.nan
    yaw_error_deg: float = np.nan
    roll_error_deg: float = np.nan
    reference_sigma_mm: float = 0.0
    sigma_mm: float = np.nan


def sum_motion(world_from_image: RigidTransform, centre_mm: npt.ArrayLike) -> MotionSums:
    """Sum the elevational travel of the image centre and the angles from frame to frame.

    Parameters
    ----------
    world_from_image : RigidTransform, length n
    centre_mm : array_like, shape (3,)
        Image centre in the image frame.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, figure 6.
    """
    centre = np.asarray(centre_mm, dtype=float)
    steps = relative_poses(world_from_image)
    roll, yaw, tilt = roll_yaw_tilt(steps.rotation).T
    along_z = (steps.apply(centre) - centre)[:, 2]
    return MotionSums(*(np.concatenate([[0.0], np.cumsum(a)]) for a in (along_z, tilt, yaw, roll)))


def monotone_parts(length_mm: npt.ArrayLike) -> list[Part]:
    """Split a sweep at the frames where the probe turns back.

    Parameters
    ----------
    length_mm : array_like, shape (n,)
        Accumulated length of the reference.

    Returns
    -------
    list of Part
        Named "f", "r", then "f2", "r2" and so on; "f" is the first, whatever its sign.
    """
    length = np.asarray(length_mm, dtype=float)
    width = min(JITTER_FRAMES, length.size)
    smooth = uniform_filter1d(median_filter(length, width, mode="nearest"), width, mode="nearest")
    edges = [0, *_turns(smooth), length.size - 1]
    ends = enumerate(pairwise(edges))
    return [Part("fr"[i % 2] + (str(i // 2 + 1) if i > 1 else ""), *part) for i, part in ends]


def _turns(length: FloatArray) -> list[int]:
    """Frames where a length without jitter turns by `HYSTERESIS_MM` and more."""
    ways = np.stack([length, -length])
    if (np.maximum.accumulate(ways, axis=1) - ways).max(axis=1).min() < HYSTERESIS_MM:
        return []  # it goes one way, as most do: the package that finds peaks takes half a second to load
    from scipy.signal import find_peaks

    peaks = [find_peaks(way, prominence=HYSTERESIS_MM)[0] for way in ways]
    return sorted(np.concatenate(peaks).tolist())


def compare_modes(
    poses: Mapping[str, RigidTransform],
    reference: RigidTransform,
    centre_mm: npt.ArrayLike,
    covered: npt.ArrayLike | None = None,
    end_frames: int = END_FRAMES,
    jitter_mm: float | None = None,
) -> list[ModeError]:
    """Errors of length, tilt, yaw and roll of every mode in every monotone part.

    Lengths and turns of a part are changes between its ends, read as the module says, of the estimate and of
    the reference alike. For an exact reference pass ``end_frames=1``: the end frames as they are.

    Parameters
    ----------
    poses : mapping of str to RigidTransform, length n
        ``world_from_image`` by mode, mm, in any world.
    reference : RigidTransform, length n or the number of covered frames
    centre_mm : array_like, shape (3,)
        Image centre in the image frame.
    covered : array_like of bool, shape (n,), optional
        Which frames have a reference; the others are left out of every sum.
    end_frames : int
        Most frames of the line at each end of a part; 1 for an exact reference.
    jitter_mm : float, optional
        Of the tracker, along the sweep, as if each frame had a reading of its own; by default from the
        frames, which have one if the tracker is as fast.

    Returns
    -------
    list of ModeError
        One for each part and mode.

    Raises
    ------
    InvalidInputError
        If there are no modes.
    MismatchError
        If modes, reference and `covered` are not of the same frames.

    Examples
    --------
    A straight sweep of 10 mm, reconstructed 5 % too long:

    >>> import numpy as np
    >>> import speckle3d as s3
    >>> from scipy.spatial.transform import RigidTransform
    >>> along_z = np.outer(np.linspace(0, 10, 51), [0, 0, 1])
    >>> truth, image = (RigidTransform.from_translation(k * along_z) for k in (1.0, 1.05))
    >>> (row,) = s3.compare_modes({"image": image}, truth, centre_mm=[19, 20, 0], end_frames=1)
    >>> print(f"{row.mode}, part {row.part}: {row.length_error_mm:.2f} mm, {row.length_error_percent:.1f} %")
    image, part f: 0.50 mm, 5.0 %

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, tables 3 and 4.
    """
    if not poses:
        raise InvalidInputError("poses: expected at least one mode, got none")
    frames = len(next(iter(poses.values()))) if covered is None else np.size(covered)
    mask = np.ones(frames, dtype=bool) if covered is None else np.asarray(covered, dtype=bool)
    true_poses = reference[mask] if len(reference) == frames else reference
    lengths = {*map(len, poses.values()), frames + len(true_poses) - int(mask.sum())}
    if lengths != {frames}:
        raise MismatchError(f"expected {frames} poses of each mode and of the reference, got {lengths}")
    true = sum_motion(true_poses, centre_mm)
    estimates = {mode: sum_motion(path[mask], centre_mm) for mode, path in poses.items()}
    rows = []
    for part in monotone_parts(true.length_mm):
        exact, reference_sigma_mm = _changes(true, part, end_frames, jitter_mm)
        reference_mm, sign = abs(exact[0]), -1.0 if exact[0] < 0 else 1.0
        for mode, estimate in estimates.items():
            most = END_FRAMES if mode == TRACKER else end_frames
            changes, sigma_mm = _changes(estimate, part, most, jitter_mm)
            error_mm = sign * (changes[0] - exact[0])
            percent = 100.0 * error_mm / reference_mm if reference_mm else np.nan
            turns = np.rad2deg(np.subtract(changes[1:], exact[1:])).tolist()
            jitter_sigma_mm = sigma_mm if mode == TRACKER else np.nan
            errors = reference_mm + error_mm, error_mm, percent, *turns, reference_sigma_mm, jitter_sigma_mm
            rows.append(ModeError(part.name, mode, part.last - part.first + 1, reference_mm, *errors))
    return rows


def part_lengths(
    poses: Mapping[str, RigidTransform], centre_mm: npt.ArrayLike
) -> tuple[list[Part], dict[str, FloatArray]]:
    """Parts of a sweep without a reference, by its first mode, and the length of each in every mode, mm.

    A sweep that does not turn round is one part, "all".

    Parameters
    ----------
    poses : mapping of str to RigidTransform, length n
        ``world_from_image`` by mode, mm, in any world.
    """
    motions = {mode: sum_motion(path, centre_mm) for mode, path in poses.items()}
    first = next(iter(motions.values())).length_mm
    parts = monotone_parts(first)
    if len(parts) == 1:
        parts = [Part("all", 0, len(first) - 1)]
    lengths = {
        mode: np.abs([_changes(motion, part, END_FRAMES if mode == TRACKER else 1)[0][0] for part in parts])
        for mode, motion in motions.items()
    }
    return parts, lengths


def read_end(values: FloatArray, end_frames: int = END_FRAMES) -> float:
    """Value at the end, from a Theil-Sen line through the last values.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Of a part of a sweep; a tenth of them lie on the line.
    end_frames : int
        Most values on the line.
    """
    end = values[-_width(values.size, end_frames) :]
    if end.size < 3:
        return float(end[-1])
    first, last = np.triu_indices(end.size, 1)
    slope = np.median((end[last] - end[first]) / (last - first))
    return float(np.median(end - slope * np.arange(1 - end.size, 1)))


def jitter_of(length_mm: FloatArray) -> float:
    """Standard deviation of a tracker's jitter along the sweep, mm; NaN for fewer than eight readings.

    By third differences: a hand is too smooth to have any at 25 frames/s, white noise of
    standard deviation s gives them ``sqrt(20) s``.

    Parameters
    ----------
    length_mm : ndarray, shape (n,)
        Accumulated by the tracker; its steps telescope, so that one reading's jitter is in one value.
    """
    if length_mm.size < 8:
        return np.nan
    return robust_sigma(np.diff(length_mm, 3)) / 20**0.5


def _width(size: int, end_frames: int) -> int:
    return max(1, min(end_frames, size // 10))


def _changes(
    motion: MotionSums, part: Part, end_frames: int, jitter_mm: float | None = None
) -> tuple[list[float], float]:
    """Change of length, tilt, yaw and roll over a part, and the length's deviation by jitter at both ends."""
    inside = [values[part.first : part.last + 1] for values in motion]
    changes = [read_end(values, end_frames) - read_end(values[::-1], end_frames) for values in inside]
    width = _width(inside[0].size, end_frames)
    variance = _LINE_EXCESS * (4 * width - 2) / (width * (width + 1)) if width > 2 else 1.0
    if jitter_mm is None:
        jitter_mm = jitter_of(motion.length_mm)
    return changes, jitter_mm * (2.0 * variance) ** 0.5 if end_frames > 1 else 0.0
