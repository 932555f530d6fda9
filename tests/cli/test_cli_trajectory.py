import json

import numpy as np
import pytest

from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.io.tum import read_tum


def test_what_is_exported_is_read_back(run, reconstructed, tmp_path):
    for unit in ("m", "mm"):
        options = ("--mode", "pose", "--length-unit", unit)
        code, out, err = run("trajectory", "export", reconstructed / "reconstruction.h5", "-o",
                             tmp_path / "pose.tum", *options)  # fmt: skip
        assert (code, out) == (0, ""), err
        back = read_tum(tmp_path / "pose.tum", unit)
        held = read_reconstruction(reconstructed / "reconstruction.h5")
        np.testing.assert_array_equal(back.time_s, held.frame_time_s)
        expected = held.poses["pose"].as_matrix()
        np.testing.assert_allclose(back.world_from_sensor.as_matrix(), expected, rtol=0, atol=1e-9)


def test_a_reconstruction_is_scored_as_its_exported_text_is(run, bench, reconstructed, tmp_path):
    run("trajectory", "export", reconstructed / "reconstruction.h5", "-o", tmp_path / "image.tum")
    found = []
    for estimate in (reconstructed / "reconstruction.h5", tmp_path / "image.tum"):
        code, out, err = run("trajectory", "score", estimate, bench / "sweep.h5", "--json")
        assert code == 0, err
        found.append(json.loads(out))
    numbers = ("FDR_percent", "ADR_percent", "MD_mm", "SD_mm", "HD_mm", "EA_deg", "GPE_mm", "LPE_mm")
    assert [found[0][n] for n in numbers] == pytest.approx([found[1][n] for n in numbers], abs=1e-9)
    assert found[0]["APE"] == pytest.approx(found[1]["APE"], abs=1e-9)
    assert found[0]["reference"] == "sweep.h5, truth"
    assert (found[0]["poses"], found[0]["GLE_mm"]) == (24, None)
