from dataclasses import replace

import numpy as np
import pytest
from faults import spoil
from scipy.spatial.transform import Rotation

from speckle3d.config import Config
from speckle3d.core.errors import MismatchError
from speckle3d.core.geometry import rigid
from speckle3d.corrections import correct
from speckle3d.examine.disagreements import differing_lengths, disagreements
from speckle3d.examine.sensors import doubts_of_gyroscope, examine_sensors, jitter, repair_readings
from speckle3d.motion.sensors import settle_direction

AGAINST_THEMSELVES = {
    "tracker frozen": "frozen",
    "tracker frozen in the middle fifth": "frozen",
    "tracker without turns": "frozen",
    "tracker spikes of 30 mm": "spikes",
    "tracker noise of 3 mm": "noise",
    "tracker random": "scrambled",
    "orientation stored xyzw": "xyzw",
    "orientation inverted": "inverted",
    "orientation in a world upside down": "not vertical",
    "orientation mirrored": "handedness",
    "orientation x of the other sign": "axes",
    "orientation random": "scrambled",
    "orientation spikes of 180 deg": "spikes",
    "orientation constant": "frozen",
    "orientation heading drift of 5 deg/s": "drift",
}
"""Faults of `tests/faults.py` in which a sensor contradicts itself, and a word for each."""
BESIDE_THE_IMAGES = {
    "tracker in metres": "metres",
    "tracker in inches": "inches",
    "tracker matrices inverted": "length",
    "tracker mount turned by 180 deg about x": "length",
    "tracker drift of 5 mm": "x ",
    "orientation mount turned by 180 deg about x": "roll",
}
"""Faults that only the images contradict: both numbers are told."""
REFUTES = (
    *("tracker frozen", "tracker without turns", "tracker random", "orientation stored xyzw"),
    *("orientation inverted", "orientation random", "orientation mirrored"),
)
"""Faults that leave nothing of a sensor to rely on."""


def doubts_of(sweep, tracking):
    credible, doubts = examine_sensors(sweep, tracking.image)
    return credible, doubts, disagreements(credible, tracking.image, tracking.covariance, Config().fused)


def test_good_sensors_are_not_doubted(sweep, tracking):
    assert tracking.doubts == ()
    credible, doubts, conflicts = doubts_of(sweep, tracking)
    assert doubts == conflicts == ()
    assert credible.tracker is sweep.tracker
    assert credible.orientation is sweep.orientation


@pytest.mark.parametrize("name", AGAINST_THEMSELVES)
def test_a_sensor_that_contradicts_itself_is_named(name, sweep, tracking):
    _, doubts, _ = doubts_of(spoil(sweep, name), tracking)
    about = "tracker" if name.startswith("tracker") else "orientation sensor"
    assert {doubt.about for doubt in doubts} == {about}
    assert any(AGAINST_THEMSELVES[name] in doubt.suspect for doubt in doubts)
    if name in REFUTES:
        assert any("refused" in str(doubt) for doubt in doubts)


@pytest.mark.parametrize("name", BESIDE_THE_IMAGES)
def test_images_and_a_sensor_that_differ_are_told_side_by_side_and_nobody_is_left_out(name, sweep, tracking):
    credible, _, conflicts = doubts_of(spoil(sweep, name), tracking)
    assert credible.tracker
    assert credible.orientation
    assert conflicts
    assert not any(doubt.refuted for doubt in conflicts)
    assert all(doubt.evidence.count(" by the ") == 2 for doubt in conflicts)
    assert BESIDE_THE_IMAGES[name] in f"{conflicts[0].suspect} {conflicts[0].evidence}"


def test_lengths_of_modes_beyond_three_joint_claims_are_told_with_both_numbers():
    lengths = {"image": (12.0, 0.3), "pose": (10.0, 0.1), "fused": (11.5, 0.3)}
    conflicts = differing_lengths(lengths)
    assert [doubt.about for doubt in conflicts] == ["modes image and pose", "modes pose and fused"]
    assert "12.00 +- 0.59 mm" in conflicts[0].evidence
    assert "10.00 +- 0.20 mm" in conflicts[0].evidence


@pytest.mark.parametrize("name", ["orientation stored xyzw", "orientation inverted", "orientation random"])
def test_no_sign_is_taken_from_turns_that_nothing_confirms(name, sweep, tracking):
    bad = spoil(replace(sweep, tracker=None, truth=None), name)
    # Without what it measures beside its orientation, only the images are left to say so.
    bare = replace(bad, orientation=replace(bad.orientation, gyroscope_rad_s=None, accelerometer_m_s2=None))
    for spoilt_sweep in (bad, bare):
        credible, doubts = examine_sensors(spoilt_sweep, tracking.image)
        assert settle_direction(credible, tracking.image, Config().sensors, doubts) == (1, "assumed")


def test_a_sensor_that_contradicts_itself_gives_no_mode_unless_told_to(sweep, tracking):
    bad = spoil(sweep, "tracker frozen")
    _, doubts = examine_sensors(bad, tracking.image)
    with pytest.raises(MismatchError, match=r"pose.*tracker.*frozen"):
        correct(replace(tracking, doubts=doubts), bad, ["pose"])
    config = Config(sensors={"examine": False})
    assert len(correct(tracking, bad, ["pose"], config)["pose"].poses) == len(sweep)


def test_spikes_are_left_out_and_counted(sweep, tracking):
    bad = spoil(sweep, "tracker spikes of 30 mm")
    filtered_sweep, (doubt,) = repair_readings(bad)
    places = [s.tracker.readings.world_from_sensor.translation for s in (bad, sweep)]
    spikes = np.linalg.norm(places[0] - places[1], axis=1) > 10.0
    left_out = len(bad.tracker.readings) - len(filtered_sweep.tracker.readings)
    assert left_out >= spikes.sum()
    assert str(left_out) in doubt.evidence
    at = bad.tracker.readings.time_s[spikes] + bad.tracker.time_offset_s
    at = at[(at >= sweep.frame_time_s[0]) & (at <= sweep.frame_time_s[-1])]
    doubtful_frames = np.concatenate([np.arange(first, last + 1) for first, last in doubt.frames])
    assert np.isin(np.abs(sweep.frame_time_s[:, None] - at).argmin(axis=0), doubtful_frames).all()
    clean_poses, trusted_poses = (correct(tracking, s, ["pose"])["pose"].poses for s in (sweep, bad))
    ends = [(p[0].inv() * p[-1]).apply(sweep.grid.centre_mm)[2] for p in (clean_poses, trusted_poses)]
    # A tenth of the readings less: their jitter of 0.15 mm over some 20 that tell an end.
    assert ends[1] == pytest.approx(ends[0], abs=0.05)


def test_a_gyroscope_on_other_axes_does_not_refute_the_readings(sweep, tracking):
    opposite = replace(sweep.orientation, gyroscope_rad_s=-sweep.orientation.gyroscope_rad_s)
    _, doubts = examine_sensors(replace(sweep, tracker=None, orientation=opposite), tracking.image)
    assert [(doubt.refuted, "gyroscope" in doubt.suspect) for doubt in doubts] == [(False, True)]


@pytest.mark.parametrize("jitter_deg", [0.15, 0.6])
def test_readings_that_jitter_about_the_gyroscopes_turns_are_not_doubted(sweep, jitter_deg):
    sensor = sweep.orientation
    time_s = sensor.readings.time_s
    rotvec = np.deg2rad(2.0) * np.sin(np.pi * time_s[:, None] + np.arange(3))
    noise = np.random.default_rng(0).normal(0.0, np.deg2rad(jitter_deg), rotvec.shape)
    readings = replace(sensor.readings, world_from_sensor=Rotation.from_rotvec(rotvec + noise))
    rate = np.gradient(rotvec, time_s, axis=0)
    slow = replace(sensor, readings=readings, gyroscope_rad_s=rate, accelerometer_m_s2=None)
    _, jitter_rad = jitter(rigid(readings.world_from_sensor), np.zeros(3))
    assert list(doubts_of_gyroscope(slow, jitter_rad)) == []


def test_modes_by_the_images_alone_do_not_contradict_each_other():
    assert differing_lengths({"image": (12.0, 0.1), "orientation": (10.0, 0.1)}) == ()
