"""Recordings of others, against what their own or the vendor's software says of them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from xsens.logs.read import read_log

pytestmark = pytest.mark.realdata

STANDARD_GRAVITY = 9.80665


# An MT9-B at 256 Hz, at rest


@pytest.fixture(scope="module")
def mt9b(realdata):
    return realdata / "mt9b" / "MT9_data.bin"


def test_the_mt9_at_rest_feels_gravity(mt9b):
    """Within what is not compensated, 1.2 % of standard gravity here, and steady to a twelfth of that."""
    log = read_log(mt9b)
    size = np.linalg.norm(log.accelerometer_m_s2, axis=1)
    assert size.mean() == pytest.approx(STANDARD_GRAVITY, rel=0.0125)
    seconds = size[: size.size // 256 * 256].reshape(-1, 256).mean(axis=1)
    assert seconds.std() < 1e-3 * STANDARD_GRAVITY
    # Bias of an uncorrected rate sensor of 900 deg/s; the field is of the order of 1 by its unit.
    assert np.degrees(np.abs(log.gyroscope_rad_s.mean(axis=0))).max() < 1.5
    assert 0.5 < np.linalg.norm(log.magnetometer_au, axis=1).mean() < 2.0


# Text


@pytest.mark.parametrize(("unit", "lines"), [("00B421E6", 2432), ("00B421EF", 2469)])
def test_exports_of_mt_manager(realdata, unit, lines):
    path = realdata / "mtmanager-text" / "opensim-core" / f"MT_012005D6_009-001_{unit}.txt"
    log = read_log(path)
    assert (len(log), log.rate_hz, log.gaps) == (lines, pytest.approx(100.0), ())
    assert log.gyroscope_rad_s is None
    assert log.oriented.all()
    up = log.world_from_sensor.apply(log.accelerometer_m_s2)
    # A walking person: upright on average, not at every sample.
    np.testing.assert_allclose(np.median(up, axis=0), [0.0, 0.0, STANDARD_GRAVITY], atol=0.1)
    row = path.read_text().splitlines()[6].split("\t")
    matrix = np.array(row[-9:], dtype=float).reshape(3, 3).T  # column after column
    east_north_up = Rotation.from_euler("z", 90.0, degrees=True) * log.world_from_sensor[0]
    np.testing.assert_allclose(east_north_up.as_matrix(), matrix, atol=2e-6)
    assert log.counter[0] == int(row[0])


def test_exports_of_xsens_dot_with_and_without_losses(realdata):
    folder = realdata / "mtmanager-text" / "xsens-dot"
    whole = read_log(folder / "Pelvis_20210820_202113_836.csv")
    assert (len(whole), whole.gaps) == (382, ())
    assert whole.rate_hz == pytest.approx(60.0, rel=1e-4)
    path = folder / "LFemur_20210820_202113_831.csv"
    lossy = read_log(path)
    counter = np.array([int(line.split(",")[0]) for line in path.read_text().splitlines()[12:]])
    np.testing.assert_array_equal(lossy.counter, counter)
    assert lossy.lost == counter[-1] - counter[0] + 1 - counter.size > 0
    for gap in lossy.gaps:
        assert gap.duration_s == pytest.approx((gap.lost + 1) / 60.0, rel=1e-3)
    assert any("without gravity" in note for note in whole.notes)
