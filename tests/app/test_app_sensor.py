"""What the sensor's page shows, of a log and of a sensor at work, computed without a browser."""

import numpy as np
import pytest
from field_scenes import simulate_motion
from scipy.spatial.transform import Rotation

from speckle3d.app.sensor.log import LogReadings
from speckle3d.app.sensor.page import sensor_page
from speckle3d.app.sensor.watch import SensorWatch
from xsens.fusion.field import Trust
from xsens.fusion.online import OnlineState
from xsens.fusion.orient import orient
from xsens.live.recording import LiveState


@pytest.fixture(scope="module")
def motion():
    return simulate_motion(np.random.default_rng(7), 12.0)


@pytest.fixture(scope="module")
def readings(motion):
    return LogReadings(motion.log)


@pytest.fixture(scope="module")
def orientation(motion):
    return orient(motion.log)


def test_columns_are_those_of_the_fusion(readings, motion, orientation):
    columns = readings.columns()
    at = np.searchsorted(motion.log.time_s, orientation.rotations.time_s - 1e-9)
    np.testing.assert_allclose(columns["z"], np.degrees(motion.log.gyroscope_rad_s[at, 2]))
    assert np.abs(np.diff(columns["heading"])).max() < 20.0
    np.testing.assert_array_equal(
        np.isfinite(columns["doubt"]), orientation.disturbed & np.isfinite(columns["field"])
    )
    # The fields of these scenes: 45 down over 18 north.
    assert np.nanmedian(columns["dip"]) == pytest.approx(np.degrees(np.arctan2(45, 18)), abs=1.0)


def live(elapsed_s, heading_deg=0.0, running=True, stray=0.01, doubtful=False, **options):
    pose = Rotation.from_euler("z", heading_deg, degrees=True)
    state = OnlineState(pose, np.full(3, 0.02), np.zeros(3), doubtful, False, running, stray, 0.0)
    usual = {"connected": True, "field": 1.0, "dip_rad": 1.1, "note": "", "fused": state}
    return LiveState(
        elapsed_s=elapsed_s, samples=100, lost=0, interruptions=0, rate_hz=100.0, world_from_sensor=pose,
        rate_rad_s=np.zeros(3), **(usual | options),
    )  # fmt: skip


def watch(states):
    watch = SensorWatch("port")
    watch.states.extend(states)
    return watch


def test_live_columns_run_to_now_without_a_jump_of_the_heading():
    source = watch([live(0.1 * k, 170.0 + k) for k in range(20)])
    columns = source.columns()
    assert (columns["t"][0], columns["t"][-1]) == (pytest.approx(-1.9), 0.0)
    np.testing.assert_allclose(np.diff(columns["heading"]), 1.0, atol=1e-6)
    np.testing.assert_allclose(columns["half"], 1.96 * np.degrees(0.02))
    sensor_page(source).view()
    assert len(watch([]).columns()["t"]) == 0


@pytest.mark.parametrize(
    ("states", "trust", "words"),
    [
        ([live(1.0, connected=False, note="the port is gone")], Trust.UNKNOWN, "the port is gone"),
        ([live(0.1 * k, doubtful=k > 7) for k in range(10)], Trust.CARE, "20.0"),
        ([live(1.0, stray=0.08)], Trust.NO, "8.0"),
    ],
)
def test_the_live_sentence_is_from_the_filters_numbers(states, trust, words):
    judgement, sentence = watch(states).judgement()
    assert judgement is trust
    assert words in sentence
