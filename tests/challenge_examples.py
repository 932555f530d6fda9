"""Scans in the challenge's layout, written by h5py alone, with what was put into them."""

import h5py
import numpy as np
from drifting import hand_sweep
from scipy.spatial.transform import Rotation

SCALE_MM = (0.25, 0.2)
WIDTH, HEIGHT, FRAMES = 8, 6, 12
SUBJECT, SCAN = "050", "LH_Par_C_DtP"


def matrix(rotation, translation):
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation.as_matrix(), translation
    return transform


TOOL_FROM_IMAGE = matrix(Rotation.from_euler("xyz", [20.0, -35.0, 80.0], degrees=True), [-60.0, 12.5, 33.0])


def write_calibration(path):
    spatial = "spatial_calibration_from_image_coordinate_system_to_tracking_tool_coordinate_system"
    blocks = {"scaling_from_pixel_to_mm": np.diag([*SCALE_MM, 1.0, 1.0]), spatial: TOOL_FROM_IMAGE}
    lines = []
    for name, block in blocks.items():
        lines += [name, *(",".join(repr(float(value)) for value in row) for row in block)]
    path.write_text("\n".join(lines) + "\n")


def write_data_set(root, split=True, landmarks=True):
    """Write one scan; returns its path, the frames, the tool's poses and the landmarks."""
    rng = np.random.default_rng(21)
    frames = rng.integers(0, 256, (FRAMES, HEIGHT, WIDTH), dtype=np.uint8)
    poses = hand_sweep(rng, FRAMES, 6.0).as_matrix()
    marks = np.column_stack(
        [rng.integers(1, FRAMES, 20), rng.integers(1, WIDTH + 1, 20), rng.integers(1, HEIGHT + 1, 20)]
    )
    path = root / "frames" / SUBJECT / f"{SCAN}.h5" if split else root / SUBJECT / f"{SCAN}.h5"
    poses_path = root / "transfs" / SUBJECT / f"{SCAN}.h5" if split else path
    for folder in {path.parent, poses_path.parent}:
        folder.mkdir(parents=True)
    with h5py.File(path, "w") as file:
        file["frames"] = frames
    with h5py.File(poses_path, "a") as file:
        file["tforms"] = poses
    if landmarks:
        (root / "landmark").mkdir()
        with h5py.File(root / "landmark" / f"landmark_{SUBJECT}.h5", "w") as file:
            file[SCAN] = marks
    write_calibration(root / "calib_matrix.csv")
    return path, frames, poses, marks


def displacements(tool_poses):
    """Global and local displacement of every pixel in mm, shape (2, n - 1, 3, HEIGHT, WIDTH), as published.

    From matrices alone: T(j <- i) = inv(C) inv(tool_j) tool_i C in mm, applied to the scaled pixel, counted
    from 1; the displacement is from the scaled pixel.
    """
    rows, columns = np.mgrid[1.0 : HEIGHT + 1, 1.0 : WIDTH + 1]
    in_mm = np.stack([SCALE_MM[0] * columns, SCALE_MM[1] * rows, 0 * rows, 1 + 0 * rows])
    steps = np.arange(len(tool_poses) - 1)
    tool_steps = np.linalg.inv(tool_poses[[0 * steps, steps]]) @ tool_poses[1:]
    between = np.linalg.inv(TOOL_FROM_IMAGE) @ tool_steps @ TOOL_FROM_IMAGE
    return (np.einsum("gnij,jhw->gnihw", between, in_mm) - in_mm)[:, :, :3]


def published_errors(true_tool, found_tool, marks):
    """GPE, GLE, LPE and LLE from displacement fields."""
    distance = np.linalg.norm(displacements(true_tool) - displacements(found_tool), axis=2)
    at_marks = distance[:, marks[:, 0] - 1, marks[:, 2] - 1, marks[:, 1] - 1]
    names = (("GPE_mm", "LPE_mm"), ("GLE_mm", "LLE_mm"))
    return {
        name: errors.mean()
        for of_kind, kind in zip(names, (distance, at_marks), strict=True)
        for name, errors in zip(of_kind, kind, strict=True)
    }
