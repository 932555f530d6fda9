"""What the sensor's pages show, computed without a browser."""

import numpy as np
import pytest
from field_scenes import simulated, with_readings
from scipy.spatial.transform import Rotation

from speckle3d.app.sensor.live import columns, judged
from speckle3d.app.sensor.probe import ProbePicture
from speckle3d.app.sensor.readings import Readings, Trace, thinned
from xsens.fusion.field import Trust
from xsens.fusion.online import OnlineState
from xsens.live.monitor import LiveState
from xsens.logs.samples import Gap, ImuLog


@pytest.fixture(scope="module")
def motion():
    return simulated(np.random.default_rng(7), 12.0)


@pytest.fixture(scope="module")
def readings(motion):
    return Readings.of(motion.log)


def test_the_orientation_at_a_time_is_the_fusions(readings):
    stream = readings.found.rotations
    for k in (0, 500, len(stream) - 1):
        held = readings.orientation_at(float(stream.time_s[k]) - readings.start_s)
        assert (held * stream.world_from_sensor[k].inv()).magnitude() < 1e-9
    between = readings.orientation_at(float(stream.time_s[500:502].mean()) - readings.start_s)
    pair = stream.world_from_sensor[500:502]
    assert (between * pair.mean().inv()).magnitude() < 1e-6


def test_the_dip_is_that_of_the_field_in_the_world(readings):
    (dip,) = readings.dip()
    # The fields of these scenes: 45 down over 18 north.
    assert np.median(dip.values) == pytest.approx(np.degrees(np.arctan2(45, 18)), abs=1.0)
    (norm,) = readings.norm()
    assert np.median(norm.values) == pytest.approx(1.0)


def test_the_heading_has_the_fusions_band_and_no_jumps(readings):
    heading, half = readings.heading()
    assert np.abs(np.diff(heading.values)).max() < 20.0
    np.testing.assert_allclose(half, 1.96 * np.degrees(readings.found.standard_deviation_rad[:, 2]))


def test_a_log_without_readings_shows_the_sensors_own_and_says_why_nothing_is_judged():
    turns = Rotation.from_euler("z", np.linspace(0, 90, 50)[:, None], degrees=True)
    log = ImuLog(np.arange(50) / 50, world_from_sensor=turns, gaps=(Gap(9, 3, 0.08),), source="own")
    shown = Readings.of(log)
    assert shown.trust is Trust.UNKNOWN
    assert "no readings of one" in shown.sentence()
    assert shown.rotations()[2] == "the sensor's own"
    heading, half = shown.heading()
    assert (heading.values[-1], half.max()) == (pytest.approx(90.0), 0.0)
    assert shown.gaps() == [(pytest.approx(9 / 50), 0.08)]
    assert "3 samples in 1 gaps" in shown.losses()


def test_a_log_with_a_field_alone_says_what_is_missing(motion):
    lone = with_readings(motion.log, gyroscope_rad_s=None)
    assert "expected gyroscope" in Readings.of(lone).sentence()


def test_stretches_of_disbelief_are_those_of_the_fusion(readings):
    inside = np.zeros(len(readings.found), dtype=bool)
    times = readings.found.rotations.time_s - readings.start_s
    for begin, end in readings.disbelieved():
        inside |= (times >= begin) & (times <= end)
    np.testing.assert_array_equal(inside, readings.found.disturbed)


def test_thinning_keeps_every_extreme_and_what_is_near():
    rng = np.random.default_rng(1)
    values = rng.normal(size=100_000)
    values[[31_415, 92_653]] = 50.0, -50.0
    values[5] = np.nan
    trace = Trace("", np.arange(values.size) / 100.0, values)
    time_s, kept = thinned(trace, -np.inf, np.inf, most=2000)
    assert len(kept) <= 2100
    assert (np.nanmax(kept), np.nanmin(kept)) == (50.0, -50.0)
    assert (np.diff(time_s) >= 0).all()
    time_s, kept = thinned(trace, 300.0, 301.0)
    assert (time_s[0], time_s[-1], len(kept)) == (pytest.approx(299.99), pytest.approx(301.0), 102)


def test_the_probe_turns_as_it_is_held():
    picture = ProbePicture()
    before = np.concatenate(picture._patches.data["xs"])
    picture.turn(Rotation.identity())
    np.testing.assert_allclose(np.concatenate(picture._patches.data["xs"]), before)
    # Depth down: nothing is drawn below the far end of the image.
    picture.turn(Rotation.from_euler("x", -90.0, degrees=True))
    lowest = {c: min(ys) for c, ys in zip(*map(picture._patches.data.get, ("color", "ys")), strict=True)}
    assert lowest["#f2be3c"] == min(lowest.values())


def live(elapsed_s, heading_deg=0.0, started=True, stray=0.01, disturbed=False, **more):
    held = Rotation.from_euler("z", heading_deg, degrees=True)
    fused = OnlineState(held, np.full(3, 0.02), np.zeros(3), disturbed, False, started, stray, 0.0)
    usual = {"connected": True, "field": 1.0, "dip_rad": 1.1, "note": "", "fused": fused}
    return LiveState(
        elapsed_s=elapsed_s, samples=100, lost=0, interruptions=0, rate_hz=100.0, world_from_sensor=held,
        rate_rad_s=np.zeros(3), **(usual | more),
    )  # fmt: skip


def test_live_columns_run_to_now_without_a_jump_of_the_heading():
    shown = columns([live(0.1 * k, 170.0 + k) for k in range(20)])
    assert (shown["t"][0], shown["t"][-1]) == (pytest.approx(-1.9), 0.0)
    np.testing.assert_allclose(np.diff(shown["heading"]), 1.0, atol=1e-6)
    np.testing.assert_allclose(shown["high"] - shown["low"], 2 * 1.96 * np.degrees(0.02))


@pytest.mark.parametrize(
    ("states", "trust", "words"),
    [
        ([], Trust.UNKNOWN, "first samples"),
        ([live(1.0, connected=False, note="the port is gone")], Trust.UNKNOWN, "the port is gone"),
        ([live(1.0, started=False)], Trust.UNKNOWN, "still"),
        ([live(1.0, field=float("nan"))], Trust.UNKNOWN, "sends none"),
        ([live(1.0, fused=None)], Trust.UNKNOWN, "missing"),
        ([live(1.0)], Trust.YES, "can be trusted here"),
        ([live(0.1 * k, disturbed=k > 7) for k in range(10)], Trust.CARE, "20.0"),
        ([live(1.0, stray=0.08)], Trust.NO, "8.0"),
    ],
)
def test_the_live_sentence_is_from_the_filters_numbers(states, trust, words):
    found, sentence = judged(states)
    assert found is trust
    assert words in sentence
