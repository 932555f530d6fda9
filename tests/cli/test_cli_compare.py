import json

import pytest


@pytest.fixture(scope="module")
def broken_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("torn") / "torn.h5"
    path.write_bytes(b"nothing")
    return path


# Figures are closed by the report itself.
@pytest.mark.filterwarnings("default::ResourceWarning")
def test_compare_writes_a_study_and_skips_it_the_second_time(run, bench, broken_file, tmp_path):
    compare = ("compare", bench / "sweep.h5", broken_file, "-o", tmp_path / "study", "--drift", "pose")
    code, out, err = run(*compare)
    assert code == 0, err
    assert [line.split()[2] for line in out.splitlines()[2:4]] == ["image", "pose"]
    assert "torn" in err
    assert (tmp_path / "study" / "report.html").exists()
    _, out, err = run(*compare, "--json")
    assert json.loads(out)["modes"] == ["image", "pose", "tracker"]
    assert "1 of 2 sweeps" in err
    code, out, _ = run("compare", broken_file, "-o", tmp_path / "none", "--json")
    assert (code, json.loads(out)["sweeps"][0]["status"]) == (2, "failed")
