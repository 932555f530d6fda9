"""Volumes of a recording of PLUS, at its own poses."""

import numpy as np
import pytest
from image_examples import text_of, write_mha

from speckle3d.io.voxels.volumes import read_volume

PIXELS = np.array([[0.5, 0.045, 0, 1], [0.0, 0.5, 0, 2], [0, 0, 0.5, 3], [0, 0, 0, 1]])
"""Axes off square by 5.1 degrees."""

SET = """<PlusConfiguration><CoordinateDefinitions><Transform From="Image" To="Probe" Matrix="{}" />
</CoordinateDefinitions></PlusConfiguration>"""


@pytest.fixture
def recording(tmp_path):
    """Six images 0.5 mm apart, the last of them without a valid pose; their levels rise along i, j and k."""
    pixels = np.zeros((6, 10, 12), np.uint8)
    pixels += np.arange(6, dtype=np.uint8)[:, None, None] * 20
    pixels += np.arange(10, dtype=np.uint8)[:, None] * 5 + np.arange(12, dtype=np.uint8)
    frames = []
    for i in range(6):
        pose = np.eye(4)
        pose[2, 3] = 0.5 * i
        frames.append(
            {
                "Timestamp": f"{0.1 * i:.6f}",
                "ProbeToTrackerTransform": text_of(pose),
                "ProbeToTrackerTransformStatus": "OK" if i < 5 else "INVALID",
                "ImageStatus": "OK",
            }
        )
    (tmp_path / "set.xml").write_text(SET.format(text_of(PIXELS)))
    return write_mha(tmp_path / "spine.mha", pixels, frames=frames), pixels


GRID = ("--axes", "world", "--origin-mm", 1, 2, 3, "--spacing-mm", 0.5, 0.5, 0.5, "--shape", 12, 10, 5)


def test_the_whole_calibration_places_levels_as_they_are_stored(run, recording, tmp_path):
    path, pixels = recording
    code, _, told = run(
        "volume", path, "--plus-config", tmp_path / "set.xml", *GRID, "--fill-radius", 0,
        "-o", tmp_path / "v.nrrd",
    )  # fmt: skip
    assert code == 0, told
    assert "spine: 1 of 6 frames have no valid pose and are left out" in told
    volume = read_volume(tmp_path / "v.nrrd")
    assert volume.voxels.dtype == np.uint8
    assert volume.fields["levels"] == "B-mode as stored, 0 to 255"
    total, count = np.zeros(volume.shape), np.zeros(volume.shape, int)
    for k in range(5):
        for row, column in np.ndindex(10, 12):
            x, y = (PIXELS[:2, :2] @ [column, row]) / 0.5
            i, j = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
            if i < 12 and j < 10:
                total[i, j, k] += pixels[k, row, column]
                count[i, j, k] += 1
    mean = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
    np.testing.assert_allclose(volume.voxels, mean, atol=0.51)
    assert (count == 0).any()
