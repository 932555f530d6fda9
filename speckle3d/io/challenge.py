"""Scans of the TUS-REC challenge (trackerless 3-D freehand ultrasound reconstruction, 2024 and 2025) [1]_.

A scan is an HDF5 file with ``frames``, shape (n, height, width), grey levels, and ``tforms``, shape
(n, 4, 4), the tracked tool's poses in camera space, mm. Either both are in one file, ``SUBJECT/SCAN.h5``, as
in the training data of 2024, or in two, ``frames/SUBJECT/SCAN.h5`` and ``transfs/SUBJECT/SCAN.h5``. Beside or
above them lies ``calib_matrix.csv``: under a line of words each, four rows of the scaling from pixels to mm
and four of the transform from the image in mm to the tool. Landmarks, where there are any, are in
``landmark/landmark_SUBJECT.h5`` (or ``landmarks/...``), a data set per scan, shape (p, 3): the frame, counted
from 0, and x and y in pixels, counted from 1 as the calibration counts them.

The files hold no times: the published rate is 20 frames/s, the published dynamic range 83 dB.

References
----------
.. [1] Q. Li et al., TUS-REC challenge, data set and baseline, 2024 and 2025.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.printable import printable
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import BModeSettings, ImageGrid, Sweep, Tracker
from speckle3d.io.hdf5 import (
    PathLike,
    find_member,
    has_member,
    hdf5_claim,
    locate,
    open_hdf5,
    read_checked,
    read_transforms,
    reading,
    require_dataset,
)
from speckle3d.io.lazy import HDF5Slices
from speckle3d.io.readers import Reader
from speckle3d.io.text import numbers, text_lines

FORMAT = "TUS-REC scan"
FRAME_RATE_HZ = 20.0
DYNAMIC_RANGE_DB = 83.0

_CALIBRATION = "calib_matrix.csv"
_LANDMARK_FOLDERS = ("landmark", "landmarks")
_LEVELS = 3
"""Folders from a scan's own upwards in which what belongs to it may lie."""


@dataclass(frozen=True)
class Landmarks:
    """Points of single images.

    Attributes
    ----------
    frame : ndarray of int, shape (p,)
        Counted from 0.
    points_mm : ndarray, shape (p, 3)
        In the image frame.
    """

    frame: npt.NDArray[np.int64]
    points_mm: FloatArray

    def __len__(self) -> int:
        return int(self.frame.size)


def is_challenge_scan(file: h5py.File) -> bool:
    """Whether an open file is a scan: it has frames, and no format of this package's family."""
    return "format" not in file.attrs and isinstance(find_member(file, "frames"), h5py.Dataset)


def read_challenge_scan(path: PathLike) -> Sweep:
    """Read a scan as a sweep with a tracker; without one where there are no transforms.

    The image frame's origin is the centre of the first pixel.

    Raises
    ------
    InvalidInputError
        If there is no calibration beside or above the scan, or a file is not as the challenge has it.
    FileError
        If a file cannot be read.
    """
    scan = Path(path)
    frames = _frames(scan)
    scale_mm, tool_from_image = read_challenge_calibration(_require_calibration(scan))
    n, width, height = frames.shape
    times = np.arange(n) / FRAME_RATE_HZ
    poses = _tool_poses(scan, n)
    tracker = None if poses is None else Tracker(TimedPoses(times, poses), tool_from_image)
    grid = ImageGrid(width, height, scale_mm[0], scale_mm[1])
    return Sweep(
        frames, grid, BModeSettings(DYNAMIC_RANGE_DB), times, tracker=tracker, name=printable(scan.stem)
    )


def read_challenge_calibration(path: PathLike) -> tuple[FloatArray, RigidTransform]:
    """Size of a pixel, (width, height) in mm, and the pose of the image in the tool's frame.

    The challenge counts pixels from 1; here the image's origin is the first pixel.
    """
    # Lines that begin with a letter are headings.
    rows = [
        numbers(text.replace(",", " "), 4, f"{path}: line {number}")
        for number, text in text_lines(path)
        if not text[0].isalpha()
    ]
    if len(rows) != 8:
        raise InvalidInputError(f"{path}: expected eight rows of four finite numbers, got {len(rows)}")
    matrices = np.reshape(rows, (2, 4, 4))
    scale = matrices[0]
    size = np.diag(scale)[:2].copy()
    if not (np.array_equal(scale, np.diag(np.diag(scale))) and (size > 0).all() and scale[3, 3] == 1):
        raise InvalidInputError(f"{path}: expected a scaling from pixels to mm, got another matrix")
    tool_from_counted = transforms_from_matrices(matrices[1:], f"{path}: image to tool")[0]
    return size, tool_from_counted * RigidTransform.from_translation([*size, 0.0])


def read_landmarks(path: PathLike) -> Landmarks | None:
    """Landmarks of a scan, by the scan's path; None where there are none for it."""
    scan = Path(path)
    found = _landmark_file(scan)
    if found is None:
        return None
    size, _ = read_challenge_calibration(_require_calibration(scan))
    with reading(found), open_hdf5(found) as file:
        if not has_member(file, scan.stem):
            return None
        rows = read_checked(file, scan.stem, ("landmark", 3))
        where = locate(file, scan.stem)
    if not np.isfinite(rows).all() or (rows[:, 0] % 1 != 0).any() or (rows[:, 0] < 0).any():
        raise InvalidInputError(f"{where}: expected a frame and two finite coordinates in every row")
    points = np.column_stack([(rows[:, 1:] - 1.0) * size, np.zeros(len(rows))])
    return Landmarks(rows[:, 0].astype(np.int64), points)


def companion_files(path: PathLike) -> list[Path]:
    """Files beside a scan's own that say what is in it: transforms, calibration, landmarks."""
    scan = Path(path)
    found = (_transforms_file(scan), _calibration_file(scan), _landmark_file(scan))
    return [each for each in found if each is not None]


def _frames(scan: Path) -> HDF5Slices:
    with reading(scan), open_hdf5(scan) as file:
        node = require_dataset(file, "frames")
        if node.dtype != np.uint8 or node.ndim != 3 or 0 in node.shape:
            raise InvalidInputError(
                f"{locate(node)}: expected uint8 of shape (n, height, width), got {node.dtype} {node.shape}"
            )
        n, height, width = node.shape
        return HDF5Slices(scan, "frames", np.transpose, (n, width, height), node.dtype)


def _tool_poses(scan: Path, frames: int) -> RigidTransform | None:
    source = _transforms_file(scan) or scan
    with reading(source), open_hdf5(source) as file:
        if source == scan and not has_member(file, "tforms"):
            return None
        return read_transforms(file, "tforms", frames)


def _transforms_file(scan: Path) -> Path | None:
    subject = scan.parent
    beside = subject.parent.parent / "transfs" / subject.name / scan.name
    return beside if subject.parent.name == "frames" and beside.is_file() else None


def _nearby(scan: Path, names: Iterable[str]) -> Path | None:
    """First file of these names beside or above a scan."""
    folders = list(scan.absolute().parents)[:_LEVELS]
    paths = (folder / name for folder in folders for name in names)
    return next((path for path in paths if path.is_file()), None)


def _calibration_file(scan: Path) -> Path | None:
    return _nearby(scan, [_CALIBRATION])


def _require_calibration(scan: Path) -> Path:
    found = _calibration_file(scan)
    if found is None:
        raise InvalidInputError(f"{scan}: expected {_CALIBRATION} beside or above it, got none")
    return found


def _landmark_file(scan: Path) -> Path | None:
    subject = scan.absolute().parent.name
    return _nearby(scan, [f"{folder}/landmark_{subject}.h5" for folder in _LANDMARK_FOLDERS])


READER = Reader(
    FORMAT,
    hdf5_claim(is_challenge_scan),
    lambda path, _: read_challenge_scan(path),
    companions=companion_files,
    takes_settings=False,
)
