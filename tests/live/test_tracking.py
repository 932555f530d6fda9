"""Poses as they come against `track` on the same frames."""

from dataclasses import replace

import numpy as np
import pytest

import speckle3d as s3
from speckle3d.core.geometry import mirrored
from speckle3d.live.tracking import LiveTracker
from speckle3d.matching.quality import FrameFlag
from speckle3d.sheet_curves import ProbeSheet, data_sheet_curves
from speckle3d.simulation.receiver import received
from speckle3d.tracking import track

FRAMES = 24
SHEET = ProbeSheet(elevation_aperture_mm=5.0, elevation_focus_mm=20.0, band_mhz=(5.0, 10.0))


def distance_mm(sweep, poses, reference):
    """Distance of poses from others at the image's centre, whichever way the sweep went."""
    centre = sweep.grid.centre_mm
    distances = [
        np.linalg.norm(poses.apply(centre) - path.apply(centre), axis=-1)
        for path in (reference, mirrored(reference))
    ]
    return min(distances, key=np.max)


def example_part(folder, frames=FRAMES):
    """The first frames of the shipped sweep, and its curves."""
    return s3.load_sweep(folder / "phantom.h5").part(0, frames), s3.load_curves(folder / "curves.h5")


def live(sweep, curves):
    """A tracker that was given all frames, and the poses that it gave with each."""
    tracker = LiveTracker(sweep, curves, background=False)
    return tracker, [tracker.append(sweep.frames[k], k / 25) for k in range(len(sweep))]


@pytest.fixture(scope="module")
def live_sweep(data_folder):
    sweep, curves = example_part(data_folder)
    return sweep, curves, *live(sweep, curves)


def test_each_pose_is_what_the_frames_up_to_it_give(live_sweep):
    sweep, curves, _, poses = live_sweep
    for k in (3, 14, 22):
        part = track(sweep.part(0, k + 1), curves).image
        # As is asked for; 0.07 mm at frame 14, the last before poses are revised.
        assert distance_mm(sweep, poses[k].world_from_image, part[k]) < 0.1


def test_at_the_end_poses_are_those_of_the_recording(live_sweep):
    sweep, curves, tracker, _ = live_sweep
    tracker.revise(len(tracker))
    # What the tissue attenuates (here nothing; read as 0.01 dB/cm/MHz) is told by the whole sweep alone.
    assert distance_mm(sweep, tracker.poses, track(sweep, curves).image).max() < 0.006


def test_a_frame_of_noise_is_flagged_and_the_sweep_goes_on(data_folder):
    sweep, curves = example_part(data_folder)
    tracker = LiveTracker(sweep, curves, background=False)
    noise = np.random.default_rng(3).integers(-60, 60, sweep.frames.shape[1:]).astype(np.int16)
    poses = [tracker.append(noise if k == 12 else sweep.frames[k], float(k)) for k in range(20)]
    assert poses[12].flags & (FrameFlag.LIFTED | FrameFlag.NO_SPECKLE)
    assert poses[12].flags & FrameFlag.UNMATCHED
    assert not any(pose.flags for pose in poses[13:])
    whole = track(sweep.part(0, 20), curves).image
    assert distance_mm(sweep, tracker.poses, whole)[[11, 14, 19]].max() < 0.1


def test_images_that_show_no_speckle_leave_the_length_open(data_folder):
    sweep = received(example_part(data_folder, 6)[0], dynamic_range_db=60.0)
    frames = np.stack([sweep.frames[k] for k in range(len(sweep))])
    dark = np.maximum(frames - np.quantile(frames, 0.6), 0.0).astype(np.uint8)
    for images, least, most in (frames, 0.05, 0.3), (dark, 1.0, np.inf):
        grey = replace(sweep, frames=images)
        assert least < live(grey, data_sheet_curves(SHEET, grey))[0].length_sigma < most


def test_a_first_frame_that_is_not_finite_is_flagged_and_the_sweep_goes_on(data_folder):
    sweep, curves = example_part(data_folder)
    tracker = LiveTracker(sweep, curves, background=False)
    frames = np.stack([sweep.frames[k] for k in range(8)]).astype(np.float32)
    frames[0] = np.nan
    flags = [tracker.append(frame, float(k)).flags for k, frame in enumerate(frames)]
    assert flags[0] & FrameFlag.NO_SPECKLE
    assert not any(flags[2:])
