"""Compounding of a real tracked sweep against the volume PLUS made of it (nearest voxel, mean)."""

import re

import numpy as np
import pytest

from speckle3d.imaging.holes import fill_holes
from speckle3d.kernels.compounding import add_samples

pytestmark = pytest.mark.realdata


def matrix(text):
    return np.array(text.split(), dtype=float).reshape(4, 4)


@pytest.fixture(scope="module")
def volumes(realdata):
    """Our sums and counts on PLUS's grid, and PLUS's voxels, all indexed [i, j, k]."""
    sitk, folder = pytest.importorskip("SimpleITK"), realdata / "plus"
    config = (folder / "PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN.xml").read_text()
    sweep = sitk.ReadImage(folder / "SpinePhantomFreehand.igs.mha")
    plus = sitk.ReadImage(folder / "vtkVolumeReconstructorTestNNMEANvolumeRef.mha")
    probe_from_image = matrix(re.search(r'From="Image" To="Probe"\s+Matrix="([^"]*)"', config)[1])
    total, count = np.zeros(plus.GetSize(), np.float32), np.zeros(plus.GetSize(), np.uint32)
    for index, rows in enumerate(sitk.GetArrayFromImage(sweep)):
        pose = {
            sensor: matrix(sweep.GetMetaData(f"Seq_Frame{index:04d}_{sensor}ToTrackerTransform"))
            for sensor in ("Probe", "Reference")
        }
        # The calibration is skewed by 2.7 degrees, so the kernel gets it whole: no rigid pose holds it.
        reference_from_image = np.linalg.inv(pose["Reference"]) @ pose["Probe"] @ probe_from_image
        affine = reference_from_image[:3, [0, 1, 3]]
        affine[:, 2] -= plus.GetOrigin()
        image = np.require(rows.T, np.float32, ["C", "W"])
        add_samples(image, affine / np.array(plus.GetSpacing())[:, None], total, count)
    return total, count, sitk.GetArrayFromImage(plus).transpose(2, 1, 0).astype(np.float32)


def test_filled_voxels_are_those_of_plus(volumes):
    total, count, plus = volumes
    filled = count > 0
    ours = total[filled] / count[filled]
    # PLUS keeps its running mean in whole grey levels, rounded down each time: up to a few levels darker.
    assert np.corrcoef(ours, plus[filled])[0, 1] > 0.998
    assert np.abs(ours - plus[filled]).mean() < 3.0


def test_holes_resemble_those_plus_fills_with_sticks(volumes):
    total, count, plus = volumes
    with np.errstate(invalid="ignore"):
        voxels = np.asarray(total / count, np.float32)
    fill_holes(voxels, (count > 0).astype(np.uint8), 3)
    holes = (count == 0) & ~np.isnan(voxels) & (plus > 0)
    assert holes.sum() > 1e5
    # Another way of filling (lines through the hole, weighted): alike, not equal.
    assert np.corrcoef(voxels[holes], plus[holes])[0, 1] > 0.97
