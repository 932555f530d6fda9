import json

import pytest


def test_a_reconstruction_is_scored_as_its_exported_text_is(run, bench, reconstructed, tmp_path):
    run("trajectory", "export", reconstructed / "reconstruction.h5", "-o", tmp_path / "image.tum")
    found = []
    for estimate in (reconstructed / "reconstruction.h5", tmp_path / "image.tum"):
        code, out, err = run("trajectory", "score", estimate, bench / "sweep.h5", "--json")
        assert code == 0, err
        found.append(json.loads(out))
    assert found[0]["APE"] == pytest.approx(found[1]["APE"], abs=1e-9)
    assert found[0]["reference"] == "sweep.h5, truth"
    assert (found[0]["poses"], found[0]["GLE_mm"]) == (24, None)
