from dataclasses import replace

import numpy as np
import pytest
from faults import FAULTS_BY_NAME, ORIENTATION, TRACKER
from rare_faults import RARE

from speckle3d.config import Config
from speckle3d.core.errors import MismatchError
from speckle3d.correction.trust import believed, cleaned_readings, examine_sensors, without_sensors
from speckle3d.corrections import correct
from speckle3d.motion.direction import settle_direction

LENGTH_SIGMA = 0.0085
"""Claimed of the shipped sweep's length."""

# What 96 frames of a straight sweep, whose probe turns by 2 degrees, do not tell.
UNTOLD = {
    "tracker z of the other sign",
    "tracker mount turned by 20 deg about z",
    "tracker clock off by -0.25 s",
    *(f"orientation clock off by {late} s" for late in (0.25, -0.25, 0.5, 1.0)),
    *(f"orientation mount turned by 20 deg about {axis}" for axis in "xyz"),
    "orientation lags by a filter of 30 readings",
}
FAULTS = [
    fault
    for fault in (*TRACKER, *ORIENTATION, *(each for each in RARE if "image" not in each.corrupts))
    if fault.name not in UNTOLD and fault.honest != "stand"
]


def examined(sweep, tracked):
    cleaned, doubts = cleaned_readings(sweep)
    trust = examine_sensors(believed(cleaned, doubts), tracked.image, LENGTH_SIGMA)
    return (*doubts, *trust.doubts), trust


def test_good_sensors_are_not_doubted(sweep, tracked):
    assert tracked.doubts == ()
    assert tracked.direction_from == "tracker"
    doubts, trust = examined(replace(sweep, tracker=None), tracked)
    assert doubts == ()
    assert trust.turn_confirmed


@pytest.mark.slow  # 0.2 s each
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_fault_is_seen_and_the_right_sensor_named(fault, sweep, tracked):
    doubts, _ = examined(fault.into(sweep), tracked)
    assert doubts, "nothing was said"
    assert {doubt.about for doubt in doubts} == {fault.about}
    # Another sweep's stream may pass for a late one, and where an orientation sensor and a tracker contradict
    # each other alone, either may be wrong.
    if fault.honest == "refuse" and fault.about == "tracker" and "another" not in fault.name:
        assert any(doubt.refuted for doubt in doubts)


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("tracker in metres", "metres"),
        ("tracker in inches", "inches"),
        ("tracker frozen", "frozen"),
        ("tracker mirrored", "handedness"),
        ("tracker matrices inverted", "inverted"),
        ("tracker mount turned by 20 deg about y", "mounting"),
        ("tracker clock off by 0.5 s", "clock"),
        ("orientation stored xyzw", "xyzw"),
        ("orientation inverted", "inverted"),
        ("orientation mirrored", "handedness"),
        ("orientation constant", "frozen"),
    ],
)
def test_the_suspect_is_named(name, word, sweep, tracked):
    fault = FAULTS_BY_NAME[name]
    alone = replace(sweep, tracker=None) if fault.about == "orientation sensor" else sweep
    doubts, _ = examined(fault.into(alone), tracked)
    assert word in doubts[0].suspect


def test_a_refuted_sensor_gives_neither_a_sign_nor_a_mode(sweep, tracked):
    bad = FAULTS_BY_NAME["tracker in metres"].into(sweep)
    doubts, trust = examined(bad, tracked)
    # Nor does the orientation sensor tell it here: the sweep hardly turns, and chance may agree with it.
    assert settle_direction(believed(bad, doubts), tracked.image, Config().sensors, trust.turn_confirmed) == (
        tracked.direction,
        "truth",
    )
    with pytest.raises(MismatchError, match=r"pose.*tracker.*metres"):
        correct(replace(tracked, doubts=doubts), bad, ["pose"])


@pytest.mark.parametrize("name", ["orientation stored xyzw", "orientation inverted", "orientation random"])
def test_no_sign_is_taken_from_turns_that_the_images_do_not_show(name, sweep, tracked):
    alone = replace(sweep, tracker=None, truth=None)
    bad = FAULTS_BY_NAME[name].into(alone)
    # Without what it measures beside its orientation, only the images are left to say so.
    bare = replace(bad, orientation=replace(bad.orientation, gyroscope_rad_s=None, accelerometer_m_s2=None))
    for recorded in (bad, bare):
        doubts, trust = examined(recorded, tracked)
        sign = settle_direction(
            believed(recorded, doubts), tracked.image, Config().sensors, trust.turn_confirmed
        )
        assert sign == (1, "assumed")


def test_spikes_are_left_out_and_counted(sweep, tracked):
    bad = FAULTS_BY_NAME["tracker spikes of 30 mm"].into(sweep)
    cleaned, (doubt,) = cleaned_readings(bad)
    spiked = np.linalg.norm(
        bad.tracker.readings.world_from_sensor.translation
        - sweep.tracker.readings.world_from_sensor.translation,
        axis=1,
    )
    assert len(bad.tracker.readings) - len(cleaned.tracker.readings) >= (spiked > 10.0).sum()
    assert str(len(bad.tracker.readings) - len(cleaned.tracker.readings)) in doubt.evidence
    at = bad.tracker.readings.time_s[spiked > 10.0] + bad.tracker.time_offset_s
    at = at[(at >= sweep.frame_time_s[0]) & (at <= sweep.frame_time_s[-1])]
    named = np.concatenate([np.arange(first, last + 1) for first, last in doubt.frames])
    assert np.isin(np.abs(sweep.frame_time_s[:, None] - at).argmin(axis=0), named).all()
    good = correct(tracked, sweep, ["pose"])["pose"].poses
    mended = correct(tracked, bad, ["pose"])["pose"].poses
    ends = [(p[0].inv() * p[-1]).apply(sweep.grid.centre_mm)[2] for p in (good, mended)]
    # A tenth of the readings less: their jitter of 0.15 mm over some 20 that tell an end.
    assert ends[1] == pytest.approx(ends[0], abs=0.05)


def test_what_is_refuted_can_be_used_all_the_same(sweep, tracked):
    bad = FAULTS_BY_NAME["tracker in metres"].into(sweep)
    config = Config(sensors={"examine": False})
    assert len(correct(tracked, bad, ["pose"], config)["pose"].poses) == len(sweep)


def test_a_gyroscope_on_other_axes_does_not_refute_the_readings(sweep, tracked):
    turned_round = replace(sweep.orientation, gyroscope_rad_s=-sweep.orientation.gyroscope_rad_s)
    doubts, _ = examined(replace(sweep, tracker=None, orientation=turned_round), tracked)
    assert [(doubt.refuted, "gyroscope" in doubt.suspect) for doubt in doubts] == [(False, True)]


def test_a_sensor_whose_motion_is_not_the_images_tells_no_sign(sweep, tracked):
    late = FAULTS_BY_NAME["tracker clock off by 0.5 s"].into(sweep)
    _, trust = examined(late, tracked)
    assert trust.misled == {"tracker"}
    assert without_sensors(late, trust.misled).tracker is None
    _, trust = examined(FAULTS_BY_NAME["tracker x 1.1"].into(sweep), tracked)
    assert trust.misled == frozenset()
