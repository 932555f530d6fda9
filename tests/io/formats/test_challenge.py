import challenge_examples as examples
import numpy as np
import pytest

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings
from speckle3d.io.load import load_landmarks, load_sweep


@pytest.fixture(params=["one file", "two files"])
def scan(request, tmp_path):
    return examples.write_data_set(tmp_path / "data", split=request.param == "two files")


def test_a_scan_is_a_sweep(scan):
    path, frames, poses, _ = scan
    sweep = load_sweep(path)
    assert (len(sweep), sweep.name, sweep.frames.shape) == (12, examples.SCAN, (12, 8, 6))
    assert sweep.signal == BModeSettings(dynamic_range_db=83.0)
    np.testing.assert_allclose(np.diff(sweep.frame_time_s), 1 / 20)
    for i in (0, 7, -1):
        np.testing.assert_array_equal(sweep.frames[i], frames[i].T)
    assert (sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm) == examples.SCALE_MM
    # The third column and fifth row, counted from 1, in camera space by the published matrices.
    pixel = np.diag([*examples.SCALE_MM, 1.0, 1.0]) @ [3.0, 5.0, 0.0, 1.0]
    expected = poses @ examples.TOOL_FROM_IMAGE @ pixel
    ours = sweep.tracker.world_from_image(sweep.frame_time_s).apply([2 * 0.25, 4 * 0.2, 0.0])
    np.testing.assert_allclose(ours, expected[:, :3], rtol=0, atol=1e-9)


def test_landmarks_are_counted_from_frame_0_and_pixel_1(scan):
    path, _, _, marks = scan
    landmarks = load_landmarks(path)
    np.testing.assert_array_equal(landmarks.frame, marks[:, 0])
    np.testing.assert_allclose(landmarks.points_mm[:, 0], (marks[:, 1] - 1) * 0.25)
    np.testing.assert_allclose(landmarks.points_mm[:, 1], (marks[:, 2] - 1) * 0.2)
    assert not landmarks.points_mm[:, 2].any()


def test_a_test_scan_has_no_tracker_and_no_landmarks_and_needs_a_calibration(tmp_path):
    path, *_ = examples.write_data_set(tmp_path, landmarks=False)
    (tmp_path / "transfs" / examples.SUBJECT / path.name).unlink()
    assert load_sweep(path).tracker is None
    assert load_landmarks(path) is None
    (tmp_path / "calib_matrix.csv").unlink()
    with pytest.raises(InvalidInputError, match=r"calib_matrix\.csv"):
        load_sweep(path)
