import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from speckle3d.core.geometry import rotation_from_fixed_angles
from speckle3d.core.streams import TimedRotations
from xsens.accuracy.angles import (
    MechanismSettings,
    PairErrors,
    common_readings,
    mounting_from_motion,
    pair_errors,
    read_mechanism_csv,
    readings_at,
)

TILTS_DEG, YAWS_DEG = np.linspace(-16.4, 2.2, 11), np.linspace(-5.5, 5.5, 7)
"""The mechanism's settings in Housden et al., 2008."""


def grid() -> Rotation:
    """The paper's 77 orientations: eleven tilts at each of seven yaws."""
    yaw, tilt = np.deg2rad(np.meshgrid(YAWS_DEG, TILTS_DEG, indexing="ij")).reshape(2, -1)
    return rotation_from_fixed_angles(0.0, yaw, tilt)


def sample(seed: int, n: int, degrees: float = 180.0) -> Rotation:
    rng = np.random.default_rng(seed)
    return Rotation.from_rotvec(rng.uniform(-np.deg2rad(degrees), np.deg2rad(degrees), (n, 3)) / np.sqrt(3))


def about(axis: str, degrees) -> Rotation:
    return Rotation.from_euler(axis, np.reshape(degrees, (-1, 1)), degrees=True)


class TestPairErrors:
    @given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 6), k=st.integers(1, 3))
    def test_is_the_difference_of_rotation_vectors_of_each_pair_and_calibration(self, seed, n, k):
        sensor, reference, calibrations = sample(seed, n), sample(seed + 1, n, 60.0), sample(seed + 2, k)
        sensor = reference * sample(seed + 3, n, 20.0) * calibrations[0].inv()
        errors = pair_errors(sensor, reference, calibrations)
        assert errors.error_rad.shape == (k, n * (n - 1) // 2, 3)
        for p, (i, j) in enumerate(itertools.combinations(range(n), 2)):
            right = (reference[i].inv() * reference[j]).as_rotvec()
            np.testing.assert_allclose(errors.reference_rad[p], right[::-1], atol=1e-12)
            for c in range(k):
                first, second = sensor[i] * calibrations[c], sensor[j] * calibrations[c]
                relative = Rotation.from_rotvec((errors.reference_rad + errors.error_rad)[c, p, ::-1])
                assert (relative.inv() * first.inv() * second).magnitude() < 1e-9


class TestTable:
    def test_mean_and_deviation_over_all_pairs_and_calibrations(self):
        error = np.deg2rad([[[1.0, 0.0, -2.0], [3.0, 0.0, -2.0]], [[1.0, 2.0, -2.0], [3.0, 2.0, -2.0]]])
        errors = np.rad2deg(list(PairErrors(2, np.zeros((2, 3)), error).statistics().values()))
        right = [[2, 1, -2], [1, 1, 0], [5**0.5, 2**0.5, 2], [3, 2, 2], [0, 1, 0]]
        np.testing.assert_allclose(errors, right, atol=1e-12)


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

    def test_the_mounting_of_an_uncalibrated_target_comes_from_the_motion(self):
        mounting = sample(8, 1)[0]
        images = grid() * sample(9, 77, 0.1)  # the sensor's own tenth of a degree
        optical = sample(4, 1)[0] * grid() * mounting.inv()
        errors = mounting_from_motion(images, optical)
        # A tenth of a degree over turns of some five degrees, averaged over 77 frames.
        assert (errors.inv() * mounting).magnitude() < np.deg2rad(0.5)
        errors = pair_errors(images, optical * errors, Rotation.identity())
        assert np.rad2deg(np.abs(errors.error_rad).max()) < 0.6


class TestMechanism:
    def write(self, tmp_path, text):
        path = tmp_path / "settings.csv"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    @pytest.mark.parametrize(
        "text",
        [
            "-16.4,5.5,1\n2.2,0,0\n",
            "\ufeff# set by hand\r\nYaw_deg;Roll_deg;Tilt_deg\r\n5,5;1;-16,4\r\n\r\n0;0;2,2\r\n",
            "roll  yaw   tilt\n1     5.5   -16.4\n0 0 2.2\n",
        ],
    )
    def test_settings_in_any_layout(self, tmp_path, text):
        errors = read_mechanism_csv(self.write(tmp_path, text))
        expected = rotation_from_fixed_angles(*np.deg2rad([[1.0, 0.0], [5.5, 0.0], [-16.4, 2.2]]))
        assert (errors.base_from_image.inv() * expected).magnitude().max() < 1e-12
        assert errors.time_s is None

    def test_readings_are_averaged_while_the_mechanism_stands_still(self):
        times = np.arange(0.0, 20.0, 0.01)
        true = grid()[[0, 40]]
        at = np.where(times < 10.0, 0, 1)
        sensor = TimedRotations(times, true[at] * sample(1, times.size, 1.0))
        bounds = MechanismSettings(true, np.array([1.0, 11.0]), np.array([9.0, 19.0]))
        # A degree's uniform noise about each axis over sqrt(3), averaged over 800 readings: 0.02 degrees.
        assert np.rad2deg((readings_at(sensor, bounds).inv() * true).magnitude().max()) < 0.08
