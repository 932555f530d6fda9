"""Which world the sensor's own orientation is seen from, as its own readings show."""

import numpy as np
import pytest
from imu_logs import WORLDS, mtdata2_messages, samples
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError
from xsens.logs.parts import Hints
from xsens.logs.read import parse_stream
from xsens.logs.textlogs import parse_text, write_csv
from xsens.logs.worlds import Claim, settle

UNNOTICED_DEG = 1e-3
"""Six decimals of a quaternion, in degrees, tenfold."""

ENU = Claim("ENU", "the program's default", assumed=True)


@pytest.fixture(scope="module")
def s():
    return samples(300)


def mt_manager(s, turned, vectors=("Acc", "Gyr", "Mag")):
    """Text as MT Manager writes it; it does not name the world."""
    names = {"Acc": "accelerometer_m_s2", "Gyr": "gyroscope_rad_s", "Mag": "magnetometer_au"}
    heads = [f"{name}_{axis}" for name in vectors for axis in "XYZ"] + [f"Quat_q{i}" for i in range(4)]
    rows = np.column_stack([*(s[names[name]] for name in vectors), turned.as_quat(scalar_first=True)])
    lines = ["\t".join([f"{i:05d}", *(f"{v:.6f}" for v in row)]) for i, row in enumerate(rows.tolist())]
    return "\n".join(["// Update Rate: 100.0Hz", "\t".join(["PacketCounter", *heads]), *lines, ""])


def off_deg(log, truth):
    return np.degrees((log.world_from_sensor * truth.inv()).magnitude().max())


@pytest.mark.parametrize("world", WORLDS)
def test_the_readings_say_which_world_it_is(s, world):
    log = parse_text(mt_manager(s, WORLDS[world] * s["world_from_sensor"]))
    assert off_deg(log, s["world_from_sensor"]) < UNNOTICED_DEG
    (note,) = log.notes
    assert f"orientation: {world} by its own accelerometer and magnetometer" in note
    assert ("not ENU" in note) == (world != "ENU")


def test_a_message_that_names_another_world_is_told(s):
    named_enu = b"".join(
        mtdata2_messages({**s, "world_from_sensor": WORLDS["ENU"].inv() * s["world_from_sensor"]})
    )
    log = parse_stream(named_enu)  # it says ENU, and is NWU
    assert off_deg(log, s["world_from_sensor"]) < 1e-4
    assert log.notes == (
        "orientation: NWU by its own accelerometer and magnetometer, not ENU, as its messages say",
    )


def test_movement_and_iron_disturb_some_samples_only(s):
    rng = np.random.default_rng(4)
    jolted = {**s, "accelerometer_m_s2": s["accelerometer_m_s2"] + rng.normal(0.0, 3.0, (300, 3))}
    near_iron = s["magnetometer_au"].copy()
    near_iron[:90] += [0.9, -0.7, 0.4]
    log = parse_text(mt_manager({**jolted, "magnetometer_au": near_iron}, s["world_from_sensor"]))
    assert off_deg(log, s["world_from_sensor"]) < UNNOTICED_DEG


def test_a_field_of_the_south_dips_the_other_way(s):
    field = s["world_from_sensor"].inv().apply([0.4, 0.0, 1.0])
    log = parse_text(mt_manager({**s, "magnetometer_au": field}, s["world_from_sensor"]))
    assert off_deg(log, s["world_from_sensor"]) < UNNOTICED_DEG


@pytest.mark.parametrize("degrees", [-17.0, 55.0, 150.0])
def test_a_heading_that_is_not_the_fields_is_told(s, degrees):
    """The field then lies by the angle to the west of x: the north that is claimed is to the east of it."""
    turned = Rotation.from_euler("z", degrees, degrees=True) * s["world_from_sensor"]
    quaternions = turned.as_quat(scalar_first=True)
    world, notes = settle(Claim("NWU", "as said"), quaternions, s["accelerometer_m_s2"], s["magnetometer_au"])
    assert world == "NWU"
    (note,) = notes
    side = "west" if degrees < 0 else "east"
    assert f"{abs(degrees):.0f} degrees {side}" in note
    assert ("not north" in note) == (abs(degrees) > 30)


def test_without_a_steady_field_the_default_stays(s):
    with_magnet = np.tile([0.0, 3.0, 1.0], (300, 1)) + 0.1 * s["magnetometer_au"]
    turning = Rotation.from_rotvec(np.outer(np.linspace(0.0, 12.0, 300), [0.0, 0.0, 1.0]))
    force = turning.inv().apply([0.0, 0.0, 9.8])
    for field in (None, with_magnet, np.zeros((300, 3))):
        world, notes = settle(ENU, turning.as_quat(scalar_first=True), force, field)
        assert world == "ENU"
        assert "taken as ENU, the program's default: no steady field tells" in notes[0]
    # Without an accelerometer nothing is asked; with one, up is told from down.
    assert settle(ENU, turning.as_quat(scalar_first=True), None, with_magnet)[0] == "ENU"
    down = (WORLDS["NED"] * turning).as_quat(scalar_first=True)
    assert settle(ENU, down, force, None)[0] == "NED"


def test_readings_that_contradict_the_orientation_are_refused_unless_a_world_is_given(s):
    text = mt_manager(s, s["world_from_sensor"].inv())
    with pytest.raises(InvalidInputError, match=r"^text: .*ENU, NWU or NED, but .*vertical.*--world$"):
        parse_text(text)
    log = parse_text(text, Hints(world="NWU"))
    assert off_deg(log, s["world_from_sensor"].inv()) < UNNOTICED_DEG
    assert "NWU, as given, although" in log.notes[0]


def test_a_world_that_is_given_decides(s):
    log = parse_text(mt_manager(s, s["world_from_sensor"]), Hints(world="enu"))
    assert off_deg(log, WORLDS["ENU"].inv() * s["world_from_sensor"]) < UNNOTICED_DEG
    assert log.notes[0] == "orientation: ENU, as given; by its own accelerometer and magnetometer it is NWU"
    with pytest.raises(InvalidInputError, match=r"world.*'EDN'"):
        Hints(world="EDN")


def test_a_plain_file_that_was_written_here_is_taken_at_its_word(s, tmp_path):
    turned = (
        Rotation.from_euler("z", 80.0, degrees=True) * s["world_from_sensor"]
    )  # without magnetometer, say
    log = parse_text(mt_manager(s, turned), Hints(world="NWU"))
    write_csv(tmp_path / "log.csv", log)
    back = parse_text((tmp_path / "log.csv").read_text())
    assert off_deg(back, turned) < UNNOTICED_DEG


# One line each of what others recorded with MTw and MT Manager: acceleration, field, and the orientation as
# quaternion or as matrix, column after column. Published with opensim-core (testIMUHelper.cpp, Apache-2.0)
# and with gaittoolbox (its description of files, MIT); the latter's field points up: Sydney.
RECORDED = {
    "opensim-core": (
        [3.030769, 5.254238, -7.714005],
        [-0.045410, -0.266113, 0.897217],
        [0.609684, 0.730843, 0.306845, 0.519480, -0.660808, 0.541732, 0.598686, -0.170885, -0.782543],
    ),
    "gaittoolbox": (
        [8.696773, 0.341363, 4.715198],
        [0.886719, 0.420898, 0.468506],
        [0.651925, -0.318177, -0.399341, -0.560611],
    ),
}


@pytest.mark.parametrize("name", RECORDED)
def test_what_mt_manager_wrote_of_an_mtw_is_seen_from_nwu(name):
    acceleration, field, turned = RECORDED[name]
    if len(turned) == 9:
        turned = Rotation.from_matrix(np.reshape(turned, (3, 3)).T).as_quat(scalar_first=True)
    rows = (np.tile(values, (10, 1)) for values in (turned, acceleration, field))
    assert settle(ENU, *rows)[0] == "NWU"


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
    seen = Rotation.from_euler("y", 70.0, degrees=True) * s["world_from_sensor"]
    columns = [
        seen.as_quat(scalar_first=True),
        *(s[n] for n in s if n not in ("time_s", "world_from_sensor")),
    ]
    rows = np.column_stack([np.round(s["time_s"], 3), *columns]).tolist()
    text = names.format("W;X;Y;Z;" + "X;Y;Z;X;Y;Z;X;Y;Z") + "\n"
    log = parse_text(text + "\n".join(";".join(f"{v:.8g}" for v in row) for row in rows) + "\n")
    assert (len(log), log.gaps) == (300, ())
    assert log.rate_hz == pytest.approx(100.0)
    for name in ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au"):
        np.testing.assert_allclose(getattr(log, name), s[name], rtol=1e-7)
    assert off_deg(log, seen) < 1e-4
    (note,) = log.notes
    assert "by cameras" in note
