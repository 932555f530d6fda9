"""Which world the sensor's own orientation is seen from, as its own readings show."""

import numpy as np
import pytest
from imu_logs import WORLDS, samples
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError
from xsens.logs.assembly import Claim, Hints
from xsens.logs.textlogs import parse_text

UNNOTICED_DEG = 1e-3
"""Six decimals of a quaternion, in degrees, tenfold."""

ENU = Claim("ENU", "the program's default", by_default=True)


@pytest.fixture(scope="module")
def s():
    return samples(300)


def mt_manager(s, rotations, vectors=("Acc", "Gyr", "Mag")):
    """Text as MT Manager writes it; it does not name the world."""
    names = {"Acc": "accelerometer_m_s2", "Gyr": "gyroscope_rad_s", "Mag": "magnetometer_au"}
    heads = [f"{name}_{axis}" for name in vectors for axis in "XYZ"] + [f"Quat_q{i}" for i in range(4)]
    rows = np.column_stack([*(s[names[name]] for name in vectors), rotations.as_quat(scalar_first=True)])
    lines = ["\t".join([f"{i:05d}", *(f"{v:.6f}" for v in row)]) for i, row in enumerate(rows.tolist())]
    return "\n".join(["// Update Rate: 100.0Hz", "\t".join(["PacketCounter", *heads]), *lines, ""])


def off_deg(log, truth):
    return np.degrees((log.world_from_sensor * truth.inv()).magnitude().max())


@pytest.mark.parametrize("world", WORLDS)
def test_the_readings_say_which_world_it_is(s, world):
    log = parse_text(mt_manager(s, WORLDS[world] * s["world_from_sensor"]))
    assert off_deg(log, s["world_from_sensor"]) < UNNOTICED_DEG
    assert len(log.notes) == (world != "ENU")
    assert all(f"magnetometer: {world}" in note for note in log.notes)


def test_the_accelerometer_tells_where_the_scalar_stands(s):
    last_first = Rotation.from_quat(np.roll(s["world_from_sensor"].as_quat(), -1, axis=1))
    log = parse_text(mt_manager(s, last_first))
    assert off_deg(log, s["world_from_sensor"]) < UNNOTICED_DEG
    assert "the scalar is the last number" in log.notes[0]


def test_readings_against_the_orientation_raise_unless_hints_name_a_world(s):
    text = mt_manager(s, s["world_from_sensor"].inv())
    with pytest.raises(InvalidInputError, match=r"^text: .*ENU, NWU or NED, but .*vertical.*--world$"):
        parse_text(text)
    log = parse_text(text, Hints(world="NWU"))
    assert off_deg(log, s["world_from_sensor"].inv()) < UNNOTICED_DEG
    assert "NWU, as given, although" in log.notes[0]


# RepoIMU's text, whose columns are named in two lines


@pytest.mark.parametrize(
    "names",
    [
        "Time (s);Vicon Orientation;;;;IMU Acceleration;;;IMU Gyroscope;;;IMU Magnetometer;;;\n;{};",
        "Time;Vicon Orientation;;;;IMU Acceleration;;;IMU Gyroscope;;;IMU Magnetometer;;\ns;{}",
    ],
)
def test_names_in_two_lines(s, names):
    """As in its two folders; the cameras' world is not the sensor's, so that nothing is asked of it."""
    optical = Rotation.from_euler("y", 70.0, degrees=True) * s["world_from_sensor"]
    columns = [
        optical.as_quat(scalar_first=True),
        *(s[n] for n in s if n not in ("time_s", "world_from_sensor")),
    ]
    rows = np.column_stack([np.round(s["time_s"], 3), *columns]).tolist()
    text = names.format("W;X;Y;Z;" + "X;Y;Z;X;Y;Z;X;Y;Z") + "\n"
    log = parse_text(text + "\n".join(";".join(f"{v:.8g}" for v in row) for row in rows) + "\n")
    assert (len(log), log.gaps) == (300, ())
    assert log.rate_hz == pytest.approx(100.0)
    for name in ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au"):
        np.testing.assert_allclose(getattr(log, name), s[name], rtol=1e-7)
    assert off_deg(log, optical) < 1e-4
    (note,) = log.notes
    assert "by cameras" in note
