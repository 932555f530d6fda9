"""Logs as text, of every program that writes them."""

import numpy as np
import pytest
from imu_logs import WORLDS, samples
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError
from xsens.logs.assembly import Hints
from xsens.logs.textlogs import parse_text

VECTORS = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")


@pytest.fixture(scope="module")
def s():
    return samples(60)


def lines(columns, separator="\t", digits=6):
    rows = np.column_stack(columns)
    return "\n".join(separator.join(f"{value:.{digits}f}" for value in row) for row in rows.tolist()) + "\n"


def angle_to(log, world_from_sensor):
    return (log.world_from_sensor * world_from_sensor.inv()).magnitude().max()


# The MT9 software's exports


def test_angles_and_matrices_of_the_mt9_software_are_told_from_vectors(s):
    turns = s["world_from_sensor"]
    for numbers in (turns.as_euler("xyz", degrees=True), turns.as_matrix().reshape(-1, 9)):
        log = parse_text(lines([s["time_s"], numbers]))
        assert angle_to(log, turns) < 2e-6
        np.testing.assert_allclose(log.time_s, s["time_s"], atol=1e-6)
        assert (log.accelerometer_m_s2, log.counter, log.gaps) == (None, None, ())


# MT Manager's


MATRIX = [f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)]
HEAD = """// Start Time: Unknown
// Update Rate: 100.0Hz
// Filter Profile: human (46.1)
// Firmware Version: 4.0.2
"""


def mt_manager(s, separator="\t", blank=("SampleTimeFine", "UTC_Nano"), decimal="."):
    acc, matrices = s["accelerometer_m_s2"], (WORLDS["ENU"] * s["world_from_sensor"]).as_matrix()
    columns = {"PacketCounter": [f"{i:05d}" for i in range(100, 160)]}
    columns |= {name: [""] * 60 for name in blank}
    columns |= {f"Acc_{axis}": [f"{v:.6f}" for v in acc[:, i]] for i, axis in enumerate("XYZ")}
    columns |= {
        name: [f"{v:.6f}" for v in matrices[:, int(name[4]) - 1, int(name[7]) - 1]] for name in MATRIX
    }
    table = [list(columns), *map(list, zip(*columns.values(), strict=True))]
    return HEAD + "\n".join(separator.join(row).replace(".", decimal) for row in table) + "\n"


@pytest.mark.parametrize(
    ("separator", "decimal"), [("\t", "."), (";", "."), (",", "."), (";", ","), ("\t", ",")]
)
def test_column_major_matrices_and_blank_cells_whatever_the_separator(s, separator, decimal):
    log = parse_text(mt_manager(s, separator, decimal=decimal))
    assert angle_to(log, s["world_from_sensor"]) < 2e-6
    np.testing.assert_allclose(log.accelerometer_m_s2, s["accelerometer_m_s2"], atol=1e-6)
    np.testing.assert_allclose(log.time_s, s["time_s"], atol=1e-9)
    assert len(log.notes) == 1
    assert "the program's default: ENU" in log.notes[0]


# Xsens DOT's


DOT = """sep=,
DeviceTag:,zdt
FirmwareVersion:,2.0.0
OutputRate:,60Hz
Measurement Mode:,Rate quantities (with mag)
 © Xsens Technologies B. V. 2005-2021

"""


def test_rates_of_turn_of_a_dot_are_degrees_and_its_clock_microseconds(s):
    names = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z,Mag_X,Mag_Y,Mag_Z,Status\n"
    ticks = (2**32 - 500_000 + np.round(np.arange(60) * 1e6 / 60)) % 2**32
    vectors = [s["accelerometer_m_s2"], np.degrees(s["gyroscope_rad_s"]), s["magnetometer_au"]]
    rows = lines([1 + np.arange(60), ticks, *vectors, np.zeros(60)], ",").split("\n")
    del rows[10:12]
    log = parse_text(DOT + names + "\n".join(rows))
    rows = np.delete(np.arange(60), [10, 11])
    for name in VECTORS:
        np.testing.assert_allclose(getattr(log, name), s[name][rows], atol=1e-6)
    assert [(g.after_index, g.lost) for g in log.gaps] == [(9, 2)]
    assert log.duration_s == pytest.approx(59 / 60, abs=1e-5)


# Plain files


def test_a_plain_file_by_hand():
    names = "; ".join(f"gyroscope_{axis}_rad_s" for axis in "xyz")
    log = parse_text(f"# of a bench\n{names}; time_s\n0;0;1;0.5\n;;;0.6\n0;0;2;0.7\n")
    assert log.time_s.tolist() == [0.5, 0.6, 0.7]
    np.testing.assert_array_equal(log.gyroscope_rad_s[:, 2], [1.0, np.nan, 2.0])
    assert log.accelerometer_m_s2 is None


PLAIN = [f"{quantity}_{axis}" for quantity in ("acc", "gyr", "mag") for axis in "xyz"]
ROS = [
    f"{name}.{axis}"
    for name in ("linear_acceleration", "angular_velocity", "magnetic_field")
    for axis in "xyz"
]
SHORT = [f"{quantity}{axis}" for quantity in "agm" for axis in "xyz"]
SPELT = [
    f"{name} {axis} ({unit})"
    for name, unit in (("Accelerometers", "m/s^2"), ("Gyroscopes", "degrees per second"), ("Mag", "uT"))
    for axis in "XYZ"
]
UNITS = [f"{name} ({unit})" for name, unit in zip(PLAIN, 3 * ["g"] + 3 * ["deg/s"] + 3 * ["uT"], strict=True)]


@pytest.mark.parametrize(
    ("names", "separator", "scales"),
    [
        (["time_s", *PLAIN], "|", (1.0, 1.0, 1.0)),
        (["timestamp", *ROS], ",", (1e9, 1.0, 1.0)),
        (["t", *SHORT], ";", (1e3, 1.0, 1.0)),
        (["millis", *SHORT], ";", (1e3, 1.0, 1.0)),
        (["Time Startup (nanoseconds)", *SPELT], ",", (1e9, 1.0, np.rad2deg(1.0))),
        (["#timestamp [us]", *UNITS], "\t", (1e6, 1 / 9.80665, np.rad2deg(1.0))),
        (
            ["time", *PLAIN, "\nms", *3 * ["m/s^2"], *3 * ["deg/s"], *3 * ["a.u."]],
            ",",
            (1e3, 1.0, np.rad2deg(1.0)),
        ),
    ],
)
def test_columns_by_other_names_with_and_without_units(s, names, separator, scales):
    columns = [s[name] for name in ("time_s", *VECTORS)]
    rows = lines(
        [column * scale for column, scale in zip(columns, (*scales, 1.0), strict=True)], separator, 9
    )
    log = parse_text(separator.join(names).replace(separator + "\n", "\n") + "\n" + rows)
    np.testing.assert_allclose(log.time_s, s["time_s"], atol=1e-9)
    for name in VECTORS:
        np.testing.assert_allclose(getattr(log, name), s[name], atol=1e-6)


def test_dates_and_short_counters_that_wrap_round(s):
    rows = [f"2024-05-01T23:59:59.{i:02d}0Z,{(230 + i) % 256},0,0,9.8" for i in range(60) if i != 30]
    log = parse_text("timestamp,counter,acc_x,acc_y,acc_z\n" + "\n".join(rows))
    assert (log.rate_hz, log.lost, log.duration_s) == pytest.approx((100.0, 1, 0.59))


def test_steps_of_one_are_samples_unless_they_count_from_1970():
    def table(times):
        return "time,acc_x,acc_y,acc_z\n" + "".join(f"{t},0,{i},9.8\n" for i, t in enumerate(times))

    with pytest.raises(InvalidInputError, match="--rate-hz"):
        parse_text(table(range(50)))
    assert parse_text(table(range(50)), Hints(rate_hz=100.0)).rate_hz == pytest.approx(100.0)
    contradiction = parse_text(table(1_714_600_000_000 + np.arange(50)), Hints(rate_hz=50.0))
    assert contradiction.rate_hz == pytest.approx(1000.0)
    assert "50 Hz" in contradiction.notes[-1]
    # Stamps of whole seconds: the samples of each are spread over it.
    assert parse_text(table(1_714_600_000 + np.arange(300) // 60)).rate_hz == pytest.approx(60.0)
    assert len(parse_text(table([5]))) == 1
    with pytest.raises(InvalidInputError, match="--rate-hz"):
        parse_text(table([5] * 50))


@pytest.mark.parametrize(
    "header",
    ["# Sampling rate: 100 Hz", "Sample Rate (Hz): 100", "Output Frequency = 100Hz", "Update rate;100"],
)
@pytest.mark.parametrize(
    "world", ["// Coordinate system: NED", "Reference frame = NED", "CoordinateSystem;NED"]
)
def test_headers_name_rate_and_world(s, header, world):
    turns = WORLDS["NED"] * s["world_from_sensor"]
    rows = lines([np.arange(60), turns.as_quat(scalar_first=True)], ";")
    log = parse_text(f"{header}\n{world}\nsample;qw;qx;qy;qz\n{rows}")
    assert log.rate_hz == pytest.approx(100.0)
    assert angle_to(log, s["world_from_sensor"]) < 2e-6


def test_columns_of_utc_are_a_clock():
    names = "UTC_Nano UTC_Year UTC_Month UTC_Day UTC_Hour UTC_Minute UTC_Second Acc_X Acc_Y Acc_Z"
    rows = ["990000000 2024 12 31 23 59 59 0 0 9.8", "0 2025 1 1 0 0 0 0 0 9.8"]
    log = parse_text("\n".join([names, *rows]))
    assert log.duration_s == pytest.approx(0.01, abs=1e-6)
    for first in (4, 6):  # of a day or a minute without a date
        parts = [" ".join([line.split()[0], *line.split()[first:]]) for line in (names, *rows)]
        assert parse_text("\n".join(parts)).duration_s == pytest.approx(0.01, abs=1e-6)


def test_acceleration_without_gravity_is_no_accelerometers_reading(s):
    for name, gravity in (("linear_acc", 0.0), ("User Acceleration", 0.0), ("linear_acceleration.", 9.8)):
        columns = [s["time_s"], s["gyroscope_rad_s"], np.tile([0.1, 0.2, gravity], (60, 1))]
        names = ["time_s", *PLAIN[3:6], *(f"{name}_{axis}" for axis in "xyz")]
        log = parse_text(",".join(names) + "\n" + lines(columns, ","))
        assert (log.accelerometer_m_s2 is None) == (gravity == 0.0)
        assert any("without gravity" in note for note in log.notes) == (gravity == 0.0)


@pytest.mark.parametrize("factor", [1.0, 0.05])
def test_angles_that_name_no_unit_are_what_gravity_shows(s, factor):
    turns = Rotation.from_rotvec(factor * s["world_from_sensor"].as_rotvec())
    force = turns.inv().apply([0.0, 0.0, 9.8])
    for degrees in (False, True):
        columns = [s["time_s"], turns.as_euler("xyz", degrees=degrees), force]
        log = parse_text("time_s,roll,pitch,yaw,ax,ay,az\n" + lines(columns, ","))
        assert angle_to(log, turns) < 2e-6
    with pytest.raises(InvalidInputError, match="roll_deg"):
        parse_text("time_s,roll,pitch,yaw\n0,0.1,0.2,1.0\n0.1,0.1,0.2,1.0\n")


@pytest.mark.parametrize("names", ["OriInc_q{} VelInc_{}", "Delta_q_{} dv[{}]"])
def test_increments_over_the_sampling_period_are_rates(s, names):
    turns = Rotation.from_rotvec(s["gyroscope_rad_s"] / 100.0).as_quat(scalar_first=True)
    turn, step = names.split()
    head = [turn.format(i) for i in (range(4) if "q{}" in turn else "wxyz")]
    head += [step.format(i) for i in ("123" if "[" in step else "XYZ")]
    rows = lines([np.arange(60), turns, s["accelerometer_m_s2"] / 100.0], digits=9)
    log = parse_text("// Update Rate: 100.0Hz\nPacketCounter\t" + "\t".join(head) + "\n" + rows)
    for name in VECTORS[:2]:
        np.testing.assert_allclose(getattr(log, name), s[name], atol=1e-6)
