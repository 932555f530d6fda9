"""Logs as text, of every program that writes them."""

import re

import numpy as np
import pytest
from imu_logs import WORLDS, samples

from speckle3d.core.errors import InvalidInputError
from xsens.logs.parts import Hints
from xsens.logs.read import read_log
from xsens.logs.textlogs import parse_text
from xsens.logs.texttables import read_table

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


def test_angles_of_the_mt9_software(s):
    angles = s["world_from_sensor"].as_euler("xyz", degrees=True)
    log = parse_text(lines([s["time_s"], angles]))
    assert angle_to(log, s["world_from_sensor"]) < 1e-6
    np.testing.assert_allclose(log.time_s, s["time_s"], atol=1e-6)
    assert (log.accelerometer_m_s2, log.counter, log.gaps) == (None, None, ())


@pytest.mark.parametrize("temperature", [True, False])
def test_vectors_of_the_mt9_software_with_and_without_temperature(s, temperature):
    columns = [s["time_s"], *(s[name] for name in VECTORS), np.full(60, 31.25)]
    log = parse_text(lines(columns if temperature else columns[:-1]))
    for name in VECTORS:
        np.testing.assert_allclose(getattr(log, name), s[name], atol=1e-6)
    assert log.world_from_sensor is None


def test_matrices_of_the_mt9_software_are_told_from_vectors(s):
    log = parse_text(lines([s["time_s"], s["world_from_sensor"].as_matrix().reshape(-1, 9)]))
    assert angle_to(log, s["world_from_sensor"]) < 2e-6
    assert any("row by row" in note for note in log.notes)


def test_times_rounded_to_hundredths_are_no_gaps():
    time_s = np.round(np.arange(100) / 64, 2)
    log = parse_text(lines([time_s, np.zeros((100, 3))], digits=2))
    assert log.gaps == ()


# MT Manager's


MATRIX = [f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3)]
HEAD = """// Start Time: Unknown
// Update Rate: 100.0Hz
// Filter Profile: human (46.1)
// Firmware Version: 4.0.2
"""


def mt_manager(s, separator="\t", blank=("SampleTimeFine", "UTC_Nano"), decimal="."):
    acc, turned = s["accelerometer_m_s2"], (WORLDS["ENU"] * s["world_from_sensor"]).as_matrix()
    columns = {"PacketCounter": [f"{i:05d}" for i in range(100, 160)]}
    columns |= {name: [""] * 60 for name in blank}
    columns |= {f"Acc_{axis}": [f"{v:.6f}" for v in acc[:, i]] for i, axis in enumerate("XYZ")}
    columns |= {name: [f"{v:.6f}" for v in turned[:, int(name[4]) - 1, int(name[7]) - 1]] for name in MATRIX}
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
    assert "ENU, the program's default" in log.notes[0]


def test_matrices_listed_the_other_way_are_turned_by_gravity(s):
    text = mt_manager(s)
    for row, column in ((1, 2), (1, 3), (2, 3)):
        one, other = f"Mat[{row}][{column}]", f"Mat[{column}][{row}]"
        text = text.replace(one, "swapped").replace(other, one).replace("swapped", other)
    log = parse_text(text)
    assert angle_to(log, s["world_from_sensor"]) < 2e-6
    assert any("taken by columns" in note for note in log.notes)


def test_lines_between_and_after_are_left_out_and_counted(s):
    text = mt_manager(s).split("\n")
    text[12] = text[12][:40]  # truncated
    log = parse_text("\n".join([*text[:20], "", *text[20:-1], "001"]))
    assert len(log) == 59
    assert log.notes[0].startswith("2 lines")  # a blank one is none
    assert [(g.after_index, g.lost) for g in log.gaps] == [(6, 1)]


def test_windows_line_ends_and_wide_characters(s, tmp_path):
    text = mt_manager(s).replace("\n", "\r\n")
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        (tmp_path / "log.txt").write_bytes(text.encode(encoding))
        assert angle_to(read_log(tmp_path / "log.txt"), s["world_from_sensor"]) < 2e-6


def test_a_clock_of_ten_thousandths_and_its_wrap(s):
    turned = (WORLDS["ENU"] * s["world_from_sensor"]).as_quat(scalar_first=True)
    ticks = (2**32 - 3000 + 100 * np.delete(np.arange(60), [30, 31])) % 2**32
    names = "SampleTimeFine\tQuat_q0\tQuat_q1\tQuat_q2\tQuat_q3\n"
    log = parse_text(names + lines([ticks, np.delete(turned, [30, 31], axis=0)]))
    assert [(g.after_index, g.lost) for g in log.gaps] == [(29, 2)]
    assert log.duration_s == pytest.approx(0.59)
    assert angle_to(log, s["world_from_sensor"][np.delete(np.arange(60), [30, 31])]) < 2e-6


@pytest.mark.parametrize("world", ["ENU", "NED", "NWU"])
def test_the_world_may_be_told(s, world):
    turned = (WORLDS[world] * s["world_from_sensor"]).as_euler("xyz", degrees=True)
    text = "Counter\tRoll\tPitch\tYaw\n" + lines([np.arange(60), turned])
    log = parse_text(text, Hints(rate_hz=100.0, world=world))
    assert angle_to(log, s["world_from_sensor"]) < 1e-6
    assert log.notes == ()
    with pytest.raises(InvalidInputError, match=r"world.*'EDN'"):
        parse_text(text, Hints(rate_hz=100.0, world="EDN"))


@pytest.mark.parametrize("counted", [True, False])
def test_a_rate_is_the_headers_or_given(counted):
    """A program other than the vendor's wrote such files without a counter; both lack it at times."""
    rows = [[f"{i:05d}"] * counted + ["0.1", "0.2", "9.8"] for i in range(20)]
    names = ["PacketCounter"] * counted + ["Acc_X", "Acc_Y", "Acc_Z"]
    text = "\n".join("\t".join(row) for row in [names, *rows]) + "\n"
    with pytest.raises(InvalidInputError, match=r"give --rate-hz$"):
        parse_text(text)
    for log in (parse_text(text, Hints(rate_hz=50.0)), parse_text("// Update Rate: 50.0Hz\n" + text)):
        assert (len(log), log.rate_hz, log.counter is not None) == (20, pytest.approx(50.0), counted)
        assert ("samples have no counter: losses cannot be found" in log.notes) != counted


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
    kept = np.delete(np.arange(60), [10, 11])
    for name in VECTORS:
        np.testing.assert_allclose(getattr(log, name), s[name][kept], atol=1e-6)
    assert [(g.after_index, g.lost) for g in log.gaps] == [(9, 2)]
    assert log.duration_s == pytest.approx(59 / 60, abs=1e-5)


# Plain files


def test_a_plain_file_by_hand():
    names = "; ".join(f"gyroscope_{axis}_rad_s" for axis in "xyz")
    log = parse_text(f"# of a bench\n{names}; time_s\n0;0;1;0.5\n;;;0.6\n0;0;2;0.7\n")
    assert log.time_s.tolist() == [0.5, 0.6, 0.7]
    np.testing.assert_array_equal(log.gyroscope_rad_s[:, 2], [1.0, np.nan, 2.0])
    assert log.accelerometer_m_s2 is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nothing here\n", "table"),
        ("1\t2\t3\t4\t5\n", "columns.*5"),
        ("time_s,counter\n0,1\n", "columns"),
        ("acc_x,acc_y,acc_z\n", "3 cells"),
        ("acc_x,acc_y,acc_z\n1,2,3\n", "clock.*--rate-hz"),
        ("counter,acc_x,acc_y,acc_z\n1,1,2,3\n", "no rate: give --rate-hz"),
        ("// Update Rate: 1e23Hz\nPacketCounter,acc_x,acc_y,acc_z\n1,1,2,3\n", "100000 Hz, got 1e\\+23"),
        ("time_s,acc_x,acc_y,acc_z\nnan,1,2,3\n", "clock"),
        ("counter,time_s,acc_x,acc_y,acc_z\n-1,0,1,2,3\n", "time"),
    ],
)
def test_text_that_is_no_log_says_why(text, message):
    with pytest.raises(InvalidInputError, match=rf"^text: .*{message}"):
        parse_text(text)


# Tables


@pytest.mark.parametrize("cell", ["-", ".", "1-", "--1", "1.2.3", "1 2", "é", "# 2", "-nan(ind)", " "])
def test_words_are_missing_and_leave_the_other_cells_as_they_are(cell):
    rows = ["acc_x;acc_y;acc_z", "1.5;2.5;", f"{cell};3.5;-1e-3", "+0.5;nan;inf"]
    table = read_table(rows)
    expected = [[1.5, 2.5, np.nan], [np.nan, 3.5, -0.001], [0.5, np.nan, np.inf]]
    np.testing.assert_array_equal(table.values, expected)
    assert table.words == (cell != " ")


def test_columns_may_be_aligned_with_blanks():
    table = read_table(["acc_x  acc_y   acc_z", " 1   2.5   3", "10  -2   30", "1 2"])
    assert (table.values.tolist(), table.left_out) == ([[1.0, 2.5, 3.0], [10.0, -2.0, 30.0]], 1)


# Columns that are not understood, and readings that are none


def test_columns_that_are_not_understood_are_named_with_what_was_expected():
    text = "time_s,gyroscope_x_rad_s,gyroscope_y_rad_s,gyroscope_z_rad_s,accelerometer_x_furlong,remark\n"
    (note,) = parse_text(text + "0,0,0,0,1,7\n").notes
    assert re.search("accelerometer_x_furlong.*accelerometer_x_m_s2.*remark", note)
    with pytest.raises(InvalidInputError, match=r"gyr_y_turns.*gyroscope_y_rad_s"):
        parse_text("time_s,counter,gyr_x_turns,gyr_y_turns\n0,1,2,3\n")
    # Four or ten columns are no unnamed export of the MT9 software if they have names.
    with pytest.raises(InvalidInputError, match="acc_x_furlong"):
        parse_text("t,acc_x_furlong,acc_y_furlong,acc_z_furlong\n0,0,0,1\n1,0,0,1\n")


def test_an_axis_that_is_missing_is_told():
    text = "time_s,acc_x,acc_y,gyr_x,gyr_y,gyr_z\n0,0,0,0,0,0\n1,0,0,0,0,0\n"
    (note,) = parse_text(text).notes
    assert re.search("acc_x, acc_y.*expected z", note)


def test_readings_out_of_range_are_counted():
    rows = "".join(f"{i},{1e9 if i in (3, 5) else 0},0,9.8\n" for i in range(9))
    log = parse_text("time_s,acc_x,acc_y,acc_z\n" + rows)
    assert np.flatnonzero(np.isnan(log.accelerometer_m_s2).any(axis=1)).tolist() == [3, 5]
    assert "2 out of range" in log.notes[0]


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (b"\x89HDF\r\n\x1a\n" + bytes(100), "an HDF5 file"),
        (b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + bytes(100), "a MATLAB file"),
        (bytes(1000), "nothing but zeros"),
    ],
)
def test_files_of_other_kinds_are_named(tmp_path, data, kind):
    (tmp_path / "log").write_bytes(data)
    with pytest.raises(InvalidInputError, match=f"{kind}$"):
        read_log(tmp_path / "log")
