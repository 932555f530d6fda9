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

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.io.frames import FileFrames, HDF5Slices
from speckle3d.io.hdf5 import (
    PathLike,
    find_member,
    has_member,
    open_hdf5,
    read_array,
    reading,
    require_dataset,
)
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.pose_paths import tracker_of
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Value
from speckle3d.io.text import numbers, text_lines

FORMAT = "TUS-REC scan"
FRAME_RATE_HZ = 20.0
DYNAMIC_RANGE_DB = 83.0

_CALIBRATION = "calib_matrix.csv"
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

    frame: IntArray
    points_mm: FloatArray


def is_challenge_scan(file: h5py.File) -> bool:
    """Whether an open file is a scan: it has grey frames."""
    node = find_member(file, "frames")
    return isinstance(node, h5py.Dataset) and node.dtype == np.uint8 and len(node.shape or ()) == 3


def open_scan(file: h5py.File, _: ImportSettings) -> Recording:
    """Read a scan with a tracker; without one where there are no transforms.

    The image frame's origin is the centre of the first pixel.

    Raises
    ------
    InvalidInputError
        If there is no calibration beside or above the scan, or a file is not as the challenge has it.
    FileError
        If a file cannot be read.
    """
    scan = Path(file.filename)
    size_mm, tool_from_image = read_challenge_calibration(_calibration_file(scan))
    node = require_dataset(file, "frames")
    n, height, width = node.shape
    slices = HDF5Slices(scan.absolute(), ("frames",), np.transpose)
    tracker, remarks = None, list[str]()
    with open_hdf5(_transforms_file(scan) or scan) as transforms:
        if has_member(transforms, "tforms"):
            matrices = read_array(transforms, "tforms", ("pose", 4, 4))
            times_s = np.arange(len(matrices)) / FRAME_RATE_HZ
            tracker, remarks = tracker_of(times_s, matrices, tool_from_image)
            remarks += [] if len(matrices) == n else [f"tforms: {len(matrices)} poses for {n} frames"]
    values = {
        "column_pitch_mm": Value(float(size_mm[0]), _CALIBRATION),
        "row_spacing_mm": Value(float(size_mm[1]), _CALIBRATION),
        "first_sample_depth_mm": Value(0.0, "the first pixel"),
        "frame_rate_hz": Value(FRAME_RATE_HZ, "as published"),
        "dynamic_range_db": Value(DYNAMIC_RANGE_DB, "as published"),
    }
    return Recording(
        scan,
        frames=FileFrames(scan, slices, (n, width, height), node.dtype),
        values=values,
        tracker=tracker,
        chain="tforms",
        rows=(("landmarks", "none" if _landmark_file(scan) is None else "yes", ""),),
        remarks=remarks,
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
    scale, pose = np.reshape(rows, (2, 4, 4))
    size = np.diag(scale)[:2].copy()
    tool_from_corner = transforms_from_matrices(pose[None], f"{path}: image to tool")[0]
    return size, tool_from_corner * RigidTransform.from_translation([*size, 0.0])


def read_landmarks(path: PathLike) -> Landmarks | None:
    """Landmarks of a scan, by the scan's path; None where there are none for it."""
    scan = Path(path)
    source = _landmark_file(scan)
    if source is None:
        return None
    size, _ = read_challenge_calibration(_calibration_file(scan))
    with reading(source), open_hdf5(source) as file:
        if not has_member(file, scan.stem):
            return None
        rows = read_array(file, scan.stem, ("landmark", 3))
    points = np.column_stack([(rows[:, 1:] - 1.0) * size, np.zeros(len(rows))])
    return Landmarks(rows[:, 0].astype(np.int64), points)


def companion_files(scan: Path) -> list[Path]:
    """Files beside a scan's own that say what is in it: transforms, calibration, landmarks."""
    return [*filter(None, (_transforms_file(scan), _nearby(scan, _CALIBRATION), _landmark_file(scan)))]


def _transforms_file(scan: Path) -> Path | None:
    subject = scan.parent
    path = subject.parent.parent / "transfs" / subject.name / scan.name
    return path if subject.parent.name == "frames" and path.is_file() else None


def _nearby(scan: Path, *names: str) -> Path | None:
    """First file of these names beside or above a scan."""
    folders = list(scan.absolute().parents)[:_LEVELS]
    paths = (folder / name for folder in folders for name in names)
    return next((path for path in paths if path.is_file()), None)


def _calibration_file(scan: Path) -> Path:
    if (file := _nearby(scan, _CALIBRATION)) is None:
        raise InvalidInputError(f"{scan}: expected {_CALIBRATION} of TUS-REC beside or above it, got none")
    return file


def _landmark_file(scan: Path) -> Path | None:
    name = f"landmark_{scan.absolute().parent.name}.h5"
    return _nearby(scan, f"landmark/{name}", f"landmarks/{name}")


READER = Reader(FORMAT, None, open_scan, companion_files, takes_settings=False, claims_hdf5=is_challenge_scan)
