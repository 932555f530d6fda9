"""Recordings opened with the poses of their frames, and the grey levels their images are given in."""

import numpy as np
import pytest
import sweep_examples
from image_examples import frame_fields, grey, text_of, write_mha
from scipy.spatial.transform import RigidTransform

from speckle3d.core.calibration import Calibration, FramesUsed
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.reconstruction import CalibrationFile, Provenance, Reconstruction
from speckle3d.io.family.calibrations import write_calibration
from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.load import recording_sha256
from speckle3d.study.images import sweep_of
from speckle3d.study.posed import at_modes, open_posed

PIXELS = np.diag([0.1, 0.2, 0.15, 1.0])
LEANING = PIXELS.copy()
LEANING[0, 1] = 0.01
"""Rows 0.2 mm apart lie 0.01 mm aside of one another: 2.9 degrees."""


def sequence(folder, matrix=PIXELS, invalid=(), frames=4):
    fields = frame_fields(frames)[2]
    for i, frame in enumerate(fields):
        frame |= {"ImageToProbeTransform": text_of(matrix), "ImageToProbeTransformStatus": "OK"}
        if i in invalid:
            frame["ProbeToTrackerTransformStatus"] = "INVALID"
    return write_mha(folder / "a.mha", grey(frames), frames=fields)


def test_bmode_as_it_is_stored_needs_no_dynamic_range(tmp_path):
    sweep = open_posed(sequence(tmp_path))
    source, meaning = sweep.source()
    assert meaning == "B-mode as stored, 0 to 255"
    image = source.images[2]
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, grey(4)[2].T)
    for levels in ("log", "linear"):
        with pytest.raises(InvalidInputError):
            sweep.source(levels)


def test_notes_count_the_frames_without_a_valid_pose(tmp_path):
    sweep = open_posed(sequence(tmp_path, invalid=(0, 3)))
    np.testing.assert_array_equal(sweep.frames, [1, 2])
    source, _ = sweep.source()
    assert len(source) == 2
    np.testing.assert_array_equal(source.images[0], grey(4)[1].T)
    assert sweep.notes()[-1] == "a: 2 of 4 frames have no valid pose and are left out"
    whole = open_posed(sequence(tmp_path))
    assert "no valid pose" not in "".join(whole.notes())
    assert "dynamic range" not in "".join(whole.notes())
    # Cuts show no gaps between frames.
    away_mm = np.linalg.norm(np.diff(whole.world_from_image.translation, axis=0), axis=1)
    assert at_modes(whole).reach_mm > 1.9 * away_mm.max()


def test_a_reconstruction_is_opened_with_the_calibrations_it_was_made_with(tmp_path):
    sweep, mounting = sweep_examples.rf_sweep(), RigidTransform.from_translation([1.0, 2.0, 3.0])
    write_sweep(tmp_path / "s.h5", sweep)
    calibration = Calibration(
        "plane", "tracker", mounting.rotation, mounting.translation, None, 1e-6 * np.eye(6), (), 0.1, "mm",
        9.0, FramesUsed(3, (0, 1, 2)),
    )  # fmt: skip
    write_calibration(tmp_path / "c.h5", calibration)
    files = tuple(CalibrationFile("tracker", str(tmp_path / name), "") for name in ("c.h5", "gone.h5"))
    provenance = Provenance("", recording_sha256(tmp_path / "s.h5"), "1", files)
    again = sweep_of(
        Reconstruction(sweep.frame_time_s, sweep.grid, {"image": sweep.truth}, provenance), tmp_path / "s.h5"
    )
    np.testing.assert_allclose(again.tracker.sensor_from_image.as_matrix(), mounting.as_matrix())
