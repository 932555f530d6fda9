"""No command writes over what it reads, or over a file of another kind than it writes."""

import pytest
from imu_logs import samples

from xsens import ImuLog, write_csv

SMALLEST = ("--preset", "phantom", "--vectors", 16, "--samples", 600, "--frames", 3, "--length-mm", 1)


@pytest.fixture
def calls(bench, reconstructed, tmp_path):
    """What a command is given by the name of what it is to write."""
    made, log = reconstructed / "reconstruction.h5", tmp_path / "log.csv"
    write_csv(log, ImuLog(**{**samples(50), "source": "turning"}))
    return {
        "s.h5": lambda out: ("simulate", out, *SMALLEST),
        "c.h5": lambda out: ("convert", bench / "sweep.h5", out),
        "v.nrrd": lambda out: ("volume", made, "-o", out, "--voxel-mm", 1),
        "o.csv": lambda out: ("imu", "orient", log, "-o", out),
    }


@pytest.mark.parametrize("name", ["s.h5", "c.h5", "v.nrrd", "o.csv"])
def test_a_file_of_another_kind_stays_as_it_is(refused, calls, tmp_path, name):
    place = tmp_path / name
    place.write_text("precious, 1, 2\n", encoding="utf-8")
    assert str(place) in refused(*calls[name](place))
    assert place.read_text(encoding="utf-8") == "precious, 1, 2\n"


def test_an_input_stays_as_it_is(refused, bench):
    before = (bench / "sweep.h5").read_bytes()
    assert str(bench / "sweep.h5") in refused("convert", bench / "sweep.h5", bench / "sweep.h5")
    assert (bench / "sweep.h5").read_bytes() == before


@pytest.mark.parametrize("name", ["v.nrrd", "o.csv"])
def test_what_the_command_wrote_before_is_replaced(run, calls, tmp_path, name):
    for _ in range(2):
        code, _, err = run(*calls[name](tmp_path / name))
        assert code == 0, err
