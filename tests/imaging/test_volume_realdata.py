"""Compounding of a real tracked sweep against the volume PLUS made of it (nearest voxel, mean)."""

import re

import numpy as np
import pytest

from speckle3d.imaging.holes import FILLED, MEASURED, fill_holes
from speckle3d.imaging.splatting import Accumulator, fixed_maps

pytestmark = pytest.mark.realdata


def matrix(text):
    return np.array(text.split(), dtype=float).reshape(4, 4)


@pytest.fixture(scope="module")
def volumes(realdata):
    """Our voxels with their states on PLUS's grid, and PLUS's voxels, all indexed [k, j, i]."""
    sitk, folder = pytest.importorskip("SimpleITK"), realdata / "plus"
    config = (folder / "PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN.xml").read_text()
    sweep = sitk.ReadImage(folder / "SpinePhantomFreehand.igs.mha")
    plus = sitk.ReadImage(folder / "vtkVolumeReconstructorTestNNMEANvolumeRef.mha")
    probe_from_image = matrix(re.search(r'From="Image" To="Probe"\s+Matrix="([^"]*)"', config)[1])
    frames, maps = sitk.GetArrayFromImage(sweep), []
    for index in range(len(frames)):
        pose = {
            sensor: matrix(sweep.GetMetaData(f"Seq_Frame{index:04d}_{sensor}ToTrackerTransform"))
            for sensor in ("Probe", "Reference")
        }
        # The calibration is skewed by 2.7 degrees, so the kernel gets it whole: no rigid pose holds it.
        reference_from_image = np.linalg.inv(pose["Reference"]) @ pose["Probe"] @ probe_from_image
        affine = reference_from_image[:3, [0, 1, 3]]
        affine[:, 2] -= plus.GetOrigin()
        maps.append(affine / np.array(plus.GetSpacing())[:, None])
    # Rows of pixels as they are stored: lines run along the image's x.
    fixed = fixed_maps(np.array(maps), "nearest", 0, turned=True)
    rows, columns = frames.shape[1:]
    spans = np.array([[row, 0, columns] for row in range(rows)])
    accumulator = Accumulator(plus.GetSize()[::-1], frames.dtype, "nearest", "mean", countable=True)
    accumulator.add(frames, np.ones_like(frames, np.float32), fixed, spans, 1)
    return *accumulator.finish(), sitk.GetArrayFromImage(plus).astype(np.float32)


def test_filled_voxels_are_those_of_plus(volumes):
    voxels, state, plus = volumes
    filled = state == MEASURED
    ours = voxels[filled]
    # PLUS keeps its running mean in whole grey levels, rounded down each time: up to a few levels darker.
    assert np.corrcoef(ours, plus[filled])[0, 1] > 0.998
    assert np.abs(ours - plus[filled]).mean() < 3.0


def test_holes_resemble_those_plus_fills_with_sticks(volumes):
    voxels, state, plus = (each.copy() for each in volumes)
    fill_holes(voxels, state, 3)
    holes = (state == FILLED) & (plus > 0)
    assert holes.sum() > 1e5
    # Another way of filling (lines through the hole, weighted): alike, not equal.
    assert np.corrcoef(voxels[holes], plus[holes])[0, 1] > 0.97
