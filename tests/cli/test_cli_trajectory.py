import json

import pytest


def test_a_reconstruction_is_scored_as_its_exported_text_is(run, bench, results, tmp_path):
    run("trajectory", "export", results / "reconstruction.h5", "-o", tmp_path / "image.tum")
    scores = []
    for estimate in (results / "reconstruction.h5", tmp_path / "image.tum"):
        code, out, err = run("trajectory", "score", estimate, bench / "sweep.h5", "--json")
        assert code == 0, err
        scores.append(json.loads(out))
    assert scores[0]["APE"] == pytest.approx(scores[1]["APE"], abs=1e-9)
    assert scores[0]["reference"] == "sweep.h5, truth"
    assert (scores[0]["poses"], scores[0]["GLE_mm"]) == (24, None)
