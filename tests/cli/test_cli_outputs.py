"""No command writes over what it reads, or over a file of another kind than it writes."""

import pytest
from imu_logs import samples

from xsens import ImuLog, write_csv

SMALLEST = ("--preset", "phantom", "--vectors", 16, "--samples", 600, "--frames", 3, "--length-mm", 1)


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "log.csv"
    write_csv(path, ImuLog(**{**samples(50), "source": "turning"}))
    return path


@pytest.fixture
def calls(bench, reconstructed, log):
    """Commands by name, each given the place it is to write to."""
    made = reconstructed / "reconstruction.h5"
    return {
        "simulate": lambda out: ("simulate", out, *SMALLEST),
        "convert": lambda out: ("convert", bench / "sweep.h5", out),
        "volume": lambda out: ("volume", made, "-o", out, "--voxel-mm", 1),
        "imu orient": lambda out: ("imu", "orient", log, "-o", out),
    }


OUT = {
    "simulate": "s.h5",
    "convert": "c.h5",
    "volume": "v.nrrd",
    "imu orient": "o.csv",
}


@pytest.mark.parametrize("name", OUT)
def test_a_file_of_another_kind_stays_as_it_is(refused, calls, tmp_path, name):
    place = tmp_path / OUT[name]
    place.write_text("precious, 1, 2\n", encoding="utf-8")
    assert str(place) in refused(*calls[name](place))
    assert place.read_text(encoding="utf-8") == "precious, 1, 2\n"


def test_an_input_stays_as_it_is(refused, calls):
    arguments = calls["convert"]("there")
    given = next(path for path in arguments[1:] if hasattr(path, "read_bytes"))
    before = given.read_bytes()
    assert str(given) in refused(*calls["convert"](given))
    assert given.read_bytes() == before


@pytest.mark.parametrize("name", ["volume", "imu orient"])
def test_what_the_command_wrote_before_is_replaced(run, calls, tmp_path, name):
    place = tmp_path / OUT[name]
    for _ in range(2):
        code, _, err = run(*calls[name](place))
        assert code == 0, err
