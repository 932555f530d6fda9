import numpy as np
import pytest
from wire_scenes import PIXEL_MM, candidates, plus_results, scene

from calibration.nwires import label_by_wires, nwire_errors_mm, trimmed_mean_mm
from calibration.points import Detections
from speckle3d.io.load import open_recording
from speckle3d.io.plus.device_set import read_wire_phantom

PLUS_ERRORS_MM = {"Calibration": (0.479116, 0.22656), "Validation": (0.539932, 0.223536)}
"""PLUS's own means and standard deviations, mm."""


def test_frames_that_lack_wires_are_labelled_by_what_the_others_say():
    wires = scene(9, frames=20)
    missing = {(3, 4), (5, 0), (11, 7)}
    dots = candidates(wires, 1, missing=missing)
    labels = label_by_wires(dots, wires.phantom, wires.world_from_sensor, PIXEL_MM * 1.03)
    away = np.abs((labels.pixels - wires.pixels[labels.frame, labels.wire]) * PIXEL_MM).max(axis=1)
    assert (away < 0.5).sum() == 20 * 9 - 3  # five deviations of the noise
    assert (away > 0.5).sum() <= 3


@pytest.mark.realdata
@pytest.mark.parametrize("kind", ["Calibration", "Validation"])
def test_published_errors_are_reproduced_for_every_frame(realdata, kind):
    folder = realdata / "plus"
    phantom = read_wire_phantom(folder / "PlusDeviceSet_fCal_Sim_SpatialCalibration_2.0.xml").phantom
    poses = open_recording(
        folder / f"fCal_Test_{kind}_3NWires_fCal2.0.igs.mha"
    ).tracker.readings.world_from_sensor
    frames, pixels, errors, matrix = plus_results(folder, kind)
    labels = Detections(np.repeat(frames, 9), pixels.reshape(-1, 2), np.tile(np.arange(9), len(frames)))
    points = labels.points(poses[labels.frame])
    errors_mm = nwire_errors_mm(points, phantom, matrix, phantom.world_from_phantom)
    # Six digits of pixels, poses and matrix leave 0.0002 mm.
    np.testing.assert_allclose(errors_mm.reshape(3, -1).T, errors, atol=1e-3)
    np.testing.assert_allclose(trimmed_mean_mm(errors_mm), PLUS_ERRORS_MM[kind], atol=1e-4)
