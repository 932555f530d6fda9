"""Trajectories as TUM text: a line per pose, ``time_s x y z qx qy qz qw``, quaternion scalar last.

A line that starts with a hash is a comment. The format says metres, and so do files written here unless asked
otherwise; poses in memory are in mm.
"""

import re
import warnings
from contextlib import suppress

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.streams import TimedPoses
from speckle3d.io.hdf5 import PathLike, atomic_path
from speckle3d.io.pose_paths import usable
from speckle3d.io.text import parse_number, text_lines

_MM_PER_M = 1000.0
_COLUMNS = 8
_UNIT_TOLERANCE = 1e-2
"""Of a quaternion's norm: files in the wild round to four digits."""


def write_tum(path: PathLike, time_s: npt.ArrayLike, poses: RigidTransform) -> None:
    """Write poses, in mm, as TUM text with all their digits; the file appears whole or not at all.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    rows = np.column_stack([time_s, poses.translation / _MM_PER_M, poses.rotation.as_quat(canonical=True)])
    lines = ["# time_s x_m y_m z_m qx qy qz qw"]
    lines += [" ".join(repr(value) for value in row) for row in rows.tolist()]
    with atomic_path(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_tum(path: PathLike) -> TimedPoses:
    """Read TUM text into poses in mm.

    Places are in metres, as the format has it, unless a heading names x_mm. One that names qw before qx says
    that quaternions are scalar first.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If most lines are not eight finite numbers. Lines of no use, and poses
        whose time is not after the one before, are left out with a warning that counts them.
    """
    lines = [text for _, text in text_lines(path)]
    texts = [text.replace("q_", "q") for text in lines if "qw" in text or "q_w" in text or text[0] == "#"]
    heading = [word for text in texts for word in re.split(r"[\s,;#]+", text)]
    mm_per_unit = 1.0 if "x_mm" in heading else _MM_PER_M
    scalar_first = "qw" in heading and "qx" in heading[heading.index("qw") :]
    table = np.array([_eight(text) for text in lines if not text.startswith("#")]).reshape(-1, _COLUMNS)
    finite = np.isfinite(table).all(axis=1)
    sound = np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0) <= _UNIT_TOLERANCE
    words = np.where(finite, np.where(sound, "", "without a unit quaternion"), "that are not eight numbers")
    rows, notes = usable(f"{path}: poses", table[:, 0], words.tolist())
    if not rows.size or 2 * (count := np.count_nonzero(finite)) <= len(table):
        raise InvalidInputError(
            f"{path}: expected lines of eight finite numbers (time x y z qx qy qz qw, blanks between) with a "
            f"unit quaternion, got {count if rows.size else 0} of {len(table)}"
        )
    for note in notes:
        warnings.warn(note, stacklevel=2)
    time_s, places, turns = np.split(table[rows], [1, 4], axis=1)
    poses = RigidTransform.from_components(
        mm_per_unit * places, Rotation.from_quat(turns, scalar_first=scalar_first)
    )
    return TimedPoses(time_s[:, 0], poses)


def is_tum(path: PathLike) -> bool:
    """Whether the first line that is not a comment holds eight numbers."""
    with suppress(FileError, StopIteration):
        return all(np.isfinite(next(_eight(text) for _, text in text_lines(path) if text[0] != "#")))
    return False


def _eight(text: str) -> list[float]:
    """Numbers of a line; NaN unless there are eight."""
    values = [parse_number(word) for word in text.split()]
    return values if len(values) == _COLUMNS else [np.nan] * _COLUMNS
