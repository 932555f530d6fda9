import itertools
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from speckle3d.core.errors import FileError, InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.geometry import rotation_from_fixed_angles
from speckle3d.core.streams import TimedRotations
from xsens.accuracy.angles import (
    AccuracyTable,
    PairErrors,
    common_readings,
    mounting_from_motion,
    pair_errors,
)
from xsens.accuracy.figures import figure_turns, turns_about
from xsens.accuracy.mechanism import MechanismSettings, read_mechanism_csv, readings_at

TILTS_DEG, YAWS_DEG = np.linspace(-16.4, 2.2, 11), np.linspace(-5.5, 5.5, 7)
"""The mechanism's settings in Housden et al., 2008."""


def grid() -> Rotation:
    """The paper's 77 orientations: eleven tilts at each of seven yaws."""
    yaw, tilt = np.deg2rad(np.meshgrid(YAWS_DEG, TILTS_DEG, indexing="ij")).reshape(2, -1)
    return rotation_from_fixed_angles(0.0, yaw, tilt)


def some(seed: int, n: int, degrees: float = 180.0) -> Rotation:
    rng = np.random.default_rng(seed)
    return Rotation.from_rotvec(rng.uniform(-np.deg2rad(degrees), np.deg2rad(degrees), (n, 3)) / np.sqrt(3))


def about(axis: str, degrees) -> Rotation:
    return Rotation.from_euler(axis, np.reshape(degrees, (-1, 1)), degrees=True)


def measured_by(images: Rotation, calibration: Rotation, seed: int = 5) -> Rotation:
    """A perfect sensor's readings, in a world of its own."""
    return some(seed, 1)[0] * images * calibration.inv()


class TestPairErrors:
    @given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 6), k=st.integers(1, 3))
    def test_is_the_difference_of_rotation_vectors_of_each_pair_and_calibration(self, seed, n, k):
        sensor, reference, calibrations = some(seed, n), some(seed + 1, n, 60.0), some(seed + 2, k)
        sensor = reference * some(seed + 3, n, 20.0) * calibrations[0].inv()
        found = pair_errors(sensor, reference, calibrations)
        assert found.error_rad.shape == (k, n * (n - 1) // 2, 3)
        for p, (i, j) in enumerate(itertools.combinations(range(n), 2)):
            right = (reference[i].inv() * reference[j]).as_rotvec()
            np.testing.assert_allclose(found.reference_rad[p], right[::-1], atol=1e-12)
            for c in range(k):
                first, second = sensor[i] * calibrations[c], sensor[j] * calibrations[c]
                relative = Rotation.from_rotvec((found.reference_rad + found.error_rad)[c, p, ::-1])
                assert (relative.inv() * first.inv() * second).magnitude() < 1e-9

    @given(seed=st.integers(0, 2**32 - 1))
    def test_angles_are_about_the_mean_axes_of_the_pair(self, seed):
        pair = some(seed, 2)
        found = pair_errors(pair, pair, Rotation.identity())
        middle = Slerp([0.0, 1.0], pair)(0.5)
        in_world = (pair[1] * pair[0].inv()).as_rotvec()
        np.testing.assert_allclose(middle.inv().apply(in_world)[::-1], found.reference_rad[0], atol=1e-7)

    def test_a_perfect_sensor_has_no_error_whatever_its_world_and_mounting(self):
        calibration = some(3, 1)[0]
        found = pair_errors(measured_by(grid(), calibration), grid(), calibration)
        assert len(found) == 77 * 76 // 2
        assert np.abs(found.error_rad).max() < 1e-12

    def test_a_small_error_stays_small_where_the_turn_is_half_a_circle(self):
        true = about("y", [0.0, 179.9])
        read = about("y", [0.0, 180.3])
        found = pair_errors(read, true, Rotation.identity())
        np.testing.assert_allclose(np.rad2deg(found.error_rad[0, 0]), [0.0, 0.4, 0.0], atol=1e-9)

    def test_calibrations_come_as_one_rotation_or_as_many(self):
        calibrations, sensor = some(2, 4), some(7, 5)
        together = pair_errors(sensor, grid()[:5], calibrations).error_rad
        one = pair_errors(sensor, grid()[:5], calibrations[2]).error_rad
        np.testing.assert_allclose(one[0], together[2], atol=1e-14)

    def test_the_papers_experiment_has_73150_pairs(self):
        assert len(pair_errors(some(7, 77), grid(), some(2, 25))) == 73_150

    @pytest.mark.parametrize(
        ("sensor", "reference", "calibrations", "error", "message"),
        [
            (some(0, 3), some(1, 4), some(2, 1), MismatchError, "4 and 3"),
            (some(0, 1), some(1, 1), some(2, 1), InsufficientDataError, "got 1"),
            (some(0, 1)[0], some(1, 1)[0], some(2, 1), InsufficientDataError, "got 0"),
            (some(0, 3), some(1, 3), some(2, 0), InsufficientDataError, "sensor_from_image"),
            (some(0, 3200), some(1, 3200), some(2, 1), InvalidInputError, "3200"),
        ],
    )
    def test_refuses_what_it_cannot_compare(self, sensor, reference, calibrations, error, message):
        with pytest.raises(error, match=message):
            pair_errors(sensor, reference, calibrations)


class TestTable:
    def test_mean_and_deviation_over_all_pairs_and_calibrations(self):
        error = np.deg2rad([[[1.0, 0.0, -2.0], [3.0, 0.0, -2.0]], [[1.0, 2.0, -2.0], [3.0, 2.0, -2.0]]])
        errors = PairErrors(2, np.zeros((2, 3)), error)
        found = AccuracyTable.of({"bench": errors}).statistics["bench"]
        expected = {
            "mean": [2.0, 1.0, -2.0],
            "standard deviation": [1.0, 1.0, 0.0],
            "RMS": [5**0.5, 2**0.5, 2.0],
            "largest": [3.0, 2.0, 2.0],
            "standard deviation with the calibration": [0.0, 1.0, 0.0],
        }
        assert found.keys() == expected.keys()
        for what, degrees in expected.items():
            np.testing.assert_allclose(np.rad2deg(found[what]), degrees, atol=1e-12)
        assert (errors.frames, len(errors)) == (2, 4)

    def test_reads_like_table_2(self):
        error = np.deg2rad([[[-0.3651, -1.35200, -0.1017], [0.2465, 0.4254, 0.2299]]])
        errors = PairErrors(2, np.zeros((2, 3)), error)
        head, *_, row = AccuracyTable.of({"Tilt-yaw rotation": errors}).text().splitlines()
        assert head.split() == ["degrees", "Roll", "Yaw", "Tilt"]
        cells = ["-0.0593 ± 0.3058", "-0.4633 ± 0.8887", "+0.0641 ± 0.1658"]
        assert re.split("  +", row) == ["Tilt-yaw rotation", *cells]

    def test_values_name_the_experiment_the_angle_and_the_unit(self):
        errors = pair_errors(some(1, 4), some(2, 4), some(3, 2))
        values = AccuracyTable.of({"a": errors, "b": errors}).values()
        table = {what: value for what, value, _ in values}
        assert len(table) == 2 * 3 * 5
        assert {unit for *_, unit in values} == {"degrees"}
        assert table["b: yaw error, mean"] == pytest.approx(np.rad2deg(errors.error_rad[..., 1].mean()))


class TestOpticalReference:
    def test_readings_of_two_clocks_meet_at_the_references_samples(self):
        def truth(t):
            return about("y", 4.0 * np.asarray(t))

        optical = np.arange(0.0, 10.0, 0.05)
        inertial = np.arange(2.0, 9.0, 1 / 256)
        sensor = TimedRotations(inertial, truth(inertial + 0.7))  # sensor time t is reference time t + 0.7
        read, reference = common_readings(sensor, TimedRotations(optical, truth(optical)), 0.7, frames=20)
        assert len(read) == len(reference) == 20
        assert (read.inv() * reference).magnitude().max() < 1e-9
        assert reference[0].as_euler("yxz")[0] == pytest.approx(np.deg2rad(4.0 * 2.7))

    def test_frames_the_sensor_missed_are_left_out(self):
        times = np.arange(0.0, 10.0, 0.1)
        keep = (times < 3.0) | (times > 6.0)
        sensor = TimedRotations(times[keep], some(1, 1)[np.zeros(keep.sum(), int)])
        reference = TimedRotations(times, some(2, times.size))
        read, _ = common_readings(sensor, reference, frames=1000)
        assert len(read) == keep.sum()

    def test_refuses_recordings_of_different_times(self):
        sensor = TimedRotations(np.arange(5.0), some(1, 5), max_gap_s=2.0)
        reference = TimedRotations(np.arange(50.0, 60.0), some(2, 10))
        with pytest.raises(InsufficientDataError, match=r"got 0.* 50.000 to 59.000 s"):
            common_readings(sensor, reference)
        with pytest.raises(InvalidInputError, match=r"frames.* 1$"):
            common_readings(sensor, sensor, frames=1)

    def test_the_mounting_of_an_uncalibrated_target_comes_from_the_motion(self):
        mounting = some(8, 1)[0]
        images = grid() * some(9, 77, 0.1)  # the sensor's own tenth of a degree
        optical = some(4, 1)[0] * grid() * mounting.inv()
        found = mounting_from_motion(images, optical)
        # A tenth of a degree over turns of some five degrees, averaged over 77 frames.
        assert (found.inv() * mounting).magnitude() < np.deg2rad(0.5)
        errors = pair_errors(images, optical * found, Rotation.identity())
        assert np.rad2deg(np.abs(errors.error_rad).max()) < 0.6

    def test_turns_about_one_axis_do_not_tell_the_mounting(self):
        level = about("y", np.linspace(-20, 20, 30)) * some(1, 30, 0.2)
        with pytest.raises(InsufficientDataError, match="two axes"):
            mounting_from_motion(level, level)
        with pytest.raises(InsufficientDataError, match=" 0 "):
            mounting_from_motion(level[:2], level[:2])


class TestMechanism:
    def write(self, tmp_path, text):
        path = tmp_path / "settings.csv"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    @pytest.mark.parametrize(
        "text",
        [
            "tilt,yaw,roll\n-16.4,5.5,1\n2.2,0,0\n",
            "-16.4,5.5,1\n2.2,0,0\n",
            "\ufeff# set by hand\r\nYaw_deg;Roll_deg;Tilt_deg\r\n5,5;1;-16,4\r\n\r\n0;0;2,2\r\n",
            "tilt (deg)\tyaw (deg)\troll (deg)\n-16.4\t5.5\t1 # loose\n2.2\t0\t0",
            "roll  yaw   tilt\n1     5.5   -16.4\n0 0 2.2\n",
            '"tilt","yaw","roll"\n-1.64e1, 5.5, 1\n2.2, 0, 0\n',
        ],
    )
    def test_reads_settings_however_they_are_written(self, tmp_path, text):
        found = read_mechanism_csv(self.write(tmp_path, text))
        expected = rotation_from_fixed_angles(*np.deg2rad([[1.0, 0.0], [5.5, 0.0], [-16.4, 2.2]]))
        assert (found.base_from_image.inv() * expected).magnitude().max() < 1e-12
        assert found.time_s is None

    def test_the_mechanisms_order_of_axes_can_be_told(self, tmp_path):
        path = self.write(tmp_path, "tilt,yaw\n30,40\n")
        inner_yaw = Rotation.from_euler("x", 30, degrees=True) * Rotation.from_euler("y", 40, degrees=True)
        found = read_mechanism_csv(path, turns="tilt, yaw, roll").base_from_image
        assert (found.inv() * inner_yaw).magnitude().max() < 1e-12
        assert (read_mechanism_csv(path).base_from_image.inv() * inner_yaw).magnitude().max() > 0.1
        with pytest.raises(InvalidInputError, match=r"turns.*'tilt'"):
            read_mechanism_csv(path, turns="tilt")

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "settings.csv.*empty"),
            ("tilt,yaw\n", "settings.csv.*none"),
            ("tilt,roll\n1,2\n", r"settings.csv:1: .*tilt, roll"),
            ("tilt,yaw,tilt\n1,2,3\n", ":1: .*tilt, yaw, tilt"),
            ("1,2,3,4\n", ":1: .* 4$"),
            ("tilt,yaw\n1,2\n\n1,2,3\n", ":4: .* 2 .*'1, 2, 3'"),
            ("tilt,yaw\n1,x\n", ":2: .*'1, x'"),
            ("tilt,yaw\n1,inf\n", ":2: .*'1, inf'"),
            ("tilt,yaw,until_s\n1,2,3\n", ":1: .*time_s and with it until_s"),
            (
                "tilt,yaw,time_s,until_s\n1,2,3,4\n1,2,5,4\n",
                r"setting 2: .* 5 s.* 4 s",
            ),
        ],
    )
    def test_names_the_line_that_is_wrong(self, tmp_path, text, message):
        with pytest.raises(InvalidInputError, match=message):
            read_mechanism_csv(self.write(tmp_path, text))

    def test_a_missing_file_is_a_file_error(self, tmp_path):
        with pytest.raises(FileError, match=r"none\.csv"):
            read_mechanism_csv(tmp_path / "none.csv")

    @given(
        data=st.binary(max_size=200) | st.text("tilyawr,;\t 0123456789.-e\n#", max_size=60).map(str.encode)
    )
    def test_survives_any_bytes(self, tmp_path_factory, data):
        path = tmp_path_factory.getbasetemp() / "any.csv"
        path.write_bytes(data)
        try:
            assert len(read_mechanism_csv(path).base_from_image) >= 1
        except InvalidInputError as error:
            assert "\n" not in str(error)  # noqa: PT017

    def test_a_huge_file_is_refused_unread(self, tmp_path):
        path = tmp_path / "huge.csv"
        with path.open("wb") as file:
            file.truncate(10 * 2**30)
        with pytest.raises(FileError, match=r"huge.csv.*16777216"):
            read_mechanism_csv(path)

    def test_readings_are_averaged_while_the_mechanism_stands_still(self):
        times = np.arange(0.0, 20.0, 0.01)
        true = grid()[[0, 40]]
        at = np.where(times < 10.0, 0, 1)
        sensor = TimedRotations(times, true[at] * some(1, times.size, 1.0))
        bounds = MechanismSettings(true, np.array([1.0, 11.0]), np.array([9.0, 19.0]))
        # A degree's uniform noise about each axis over sqrt(3), averaged over 800 readings: 0.02 degrees.
        assert np.rad2deg((readings_at(sensor, bounds).inv() * true).magnitude().max()) < 0.08
        moments = MechanismSettings(true, np.array([1.0, 11.0]))
        assert (readings_at(sensor, moments).inv() * sensor.at([1.0, 11.0])).magnitude().max() < 1e-12
        short = MechanismSettings(true, np.array([1.001, 11.0]), np.array([1.002, 11.0]))
        assert (readings_at(sensor, short)[0].inv() * sensor.at(1.0015)).magnitude() < 1e-12

    def test_settings_without_times_are_one_per_reading(self):
        sensor = TimedRotations(np.arange(77.0), grid())
        assert readings_at(sensor, MechanismSettings(grid())) is sensor.world_from_sensor
        with pytest.raises(InsufficientDataError, match=r"3 settings.*77 readings"):
            readings_at(sensor, MechanismSettings(grid()[:3]))


class TestFigure:
    def errors(self, scale, seed=0):
        """A sensor whose yaw grows too fast, with calibrations of the paper's precision."""
        spread = np.random.default_rng(seed).normal(0.0, np.deg2rad([[1.5, 1.1, 0.08]]), (4, 3))
        yaw, tilt = np.meshgrid(YAWS_DEG * scale, TILTS_DEG, indexing="ij")
        read = rotation_from_fixed_angles(0.0, np.deg2rad(yaw).ravel(), np.deg2rad(tilt).ravel())
        return pair_errors(read, grid(), Rotation.from_rotvec(spread))

    def test_turns_are_frames_that_differ_in_one_angle_only(self):
        experiments = {"near iron": self.errors(1.3), "clear": self.errors(1.0)}
        tilting = turns_about("tilt", experiments)
        assert {turn.reference_rad.size for turn in tilting} <= {
            9,
            10,
            11,
        }  # at least three quarters of a column
        full = [turn for turn in tilting if turn.reference_rad.size == 11]
        assert len(full) == 2 * 7  # a column of the grid at each yaw and experiment
        for turn in full:
            np.testing.assert_allclose(np.rad2deg(turn.reference_rad), TILTS_DEG - TILTS_DEG[0], atol=1e-9)
        assert turns_about("roll", experiments) == []

    def test_worst_and_best_are_told_apart(self):
        experiments = {"near iron": self.errors(1.3), "clear": self.errors(1.0)}
        turns = turns_about("yaw", experiments)
        worst = max(turns, key=lambda turn: turn.drift_rad.max())
        best = min(turns, key=lambda turn: turn.drift_rad.min())
        assert (worst.experiment, best.experiment) == ("near iron", "clear")
        # 30 % of a turn of 11 degrees; the calibrations' cosine takes away less than a hundredth.
        assert np.rad2deg(worst.drift_rad.max()) == pytest.approx(3.3, abs=0.1)
        figure = figure_turns(experiments)
        titles = [axes.get_title() for axes in figure.axes]
        assert len(titles) == 4  # the mechanism did not roll
        assert titles[0].startswith("worst yaw: near iron")
        assert titles[1].startswith("best yaw: clear")

    def test_is_drawn_without_pyplot(self, python, tmp_path):
        path = tmp_path / "turns.png"
        figure_turns({"clear": self.errors(1.0)}, "Sensor").savefig(path)
        assert path.stat().st_size > 20_000
        code = "import sys, xsens.accuracy.figures; print('matplotlib.pyplot' in sys.modules)"
        assert python(code).strip() == "False"

    def test_without_any_turn_there_is_nothing_to_draw(self):
        errors = pair_errors(some(1, 6), some(2, 6), Rotation.identity())
        with pytest.raises(InsufficientDataError):
            figure_turns({"loose": errors})


def test_the_numbers_need_no_matplotlib(python):
    code = "import sys, xsens.accuracy.angles, xsens.accuracy.mechanism; print('matplotlib' in sys.modules)"
    assert python(code).strip() == "False"
