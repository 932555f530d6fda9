"""The whole pipeline on the sweep that comes with the project: 96 frames, 12 mm, with both sensors."""

from dataclasses import replace

import numpy as np
import pytest
from sweep_examples import frames_of

from speckle3d.config import Config
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import mirrored
from speckle3d.io.family.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.matching.quality import FrameFlag
from speckle3d.motion.sensors import SensorSettings, settle_direction
from speckle3d.tracking import track


def test_steps_follow_the_truth(sweep, tracking):
    centre = sweep.grid.centre_mm
    steps, true = ((p[:-1].inv() * p[1:]).apply(centre) - centre for p in (tracking.image, sweep.truth))
    # Two vectors' pitch is 0.6 mm, a step 0.13 mm on average: a tenth of a pitch and of a millimetre.
    assert np.sqrt(np.mean((steps - true) ** 2, axis=0)) == pytest.approx(0, abs=0.04)
    assert np.corrcoef(steps[:, 2], true[:, 2])[0, 1] > 0.9


def test_progress_images_and_pairs_come_in_order(sweep, curves):
    progress, images, pairs = [], [], []
    short = sweep.part(0, 12)
    tracking = track(
        short,
        curves,
        progress=lambda *step: progress.append(step),
        sink=pairs.append,
        images=lambda index, image: images.append((index, image.shape[0])),
    )
    assert progress == [(i + 1, 12) for i in range(12)]
    assert images == [(i, sweep.grid.vectors) for i in range(12)]
    assert sum(len(table) for table in pairs) == len(tracking.edges)
    seconds = np.concatenate([table.second for table in pairs])
    assert (np.diff(seconds) >= 0).all()
    assert all((table.first < table.second).all() for table in pairs)


def test_setting_then_tracker_then_nothing_settles_the_direction(sweep, tracking):
    assert tracking.direction_from == "tracker"
    assert not tracking.flags.any()
    bare = replace(sweep, tracker=None, orientation=None, truth=None)
    mirror_image = mirrored(tracking.image)
    assert settle_direction(sweep, tracking.image, SensorSettings()) == (1, "tracker")
    assert settle_direction(sweep, mirror_image, SensorSettings()) == (-1, "tracker")
    assert settle_direction(sweep, tracking.image, SensorSettings(direction=-1)) == (-1, "setting")
    assert settle_direction(bare, mirror_image, SensorSettings()) == (1, "assumed")


def spoilt(sweep, numbers, change):
    """The sweep with some frames changed by a function of the frame."""
    frames = frames_of(sweep).astype(np.float32)
    for number in numbers:
        frames[number] = change(frames[number])
    return replace(sweep, frames=frames)


def test_frames_without_speckle_are_flagged_and_too_many_refused(sweep, curves):
    short, rng = sweep.part(0, 20), np.random.default_rng(0)

    def noise(frame):
        return rng.normal(0, 300, frame.shape)

    # The last three share nothing with anything; with the last twelve it is no sweep any more.
    tracking = track(spoilt(short, range(17, 20), noise), curves)
    assert np.flatnonzero(tracking.flags).tolist() == [17, 18, 19]
    assert (tracking.flags[17:] & (FrameFlag.NO_SPECKLE | FrameFlag.LIFTED)).all()
    with pytest.raises(InsufficientDataError, match="frames"):
        track(spoilt(short, range(8, 20), noise), curves)


@pytest.mark.parametrize("gap", [(20, 21, 22, 23), (9, 10, 11)])
def test_the_path_goes_on_past_frames_without_speckle(sweep, curves, gap):
    """Where the next is 0.6 mm on, speckle itself has little left."""
    tracking = track(spoilt(sweep.part(0, 48), gap, np.zeros_like), curves)
    assert np.flatnonzero(tracking.flags).tolist() == list(gap)
    centre = sweep.grid.centre_mm
    true, estimate = (path[0].inv() * path[47] for path in (sweep.truth, tracking.image))
    assert estimate.apply(centre)[2] == pytest.approx(true.apply(centre)[2], rel=0.06)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_sweep_goes_on_from_frames_without_echo_at_its_start(sweep, curves, value):
    tracking = track(spoilt(sweep.part(0, 20), [0, 1], lambda frame: np.full_like(frame, value)), curves)
    assert (tracking.flags[:2] & FrameFlag.NO_SPECKLE).all()
    assert not tracking.flags[3:].any()


@pytest.mark.parametrize("flag", [FrameFlag.SATURATED, FrameFlag.NO_SPECKLE])
def test_a_spoilt_frame_is_placed_between_its_neighbours_and_not_trusted(sweep, curves, flag):
    short = sweep.part(0, 24)
    clean_tracking = track(short, curves)
    gain = 30 if flag == FrameFlag.SATURATED else 0
    tracking = track(spoilt(short, [11], lambda f: np.clip(gain * f.astype(int), -8192, 8191)), curves)
    assert tracking.flags[11] & flag
    assert not np.delete(tracking.flags, 11).any()
    centre = sweep.grid.centre_mm
    z, expected = (t.image.apply(centre)[:, 2] for t in (tracking, clean_tracking))
    # Some eight frames to the millimetre: a frame between its neighbours is a tremor off.
    assert np.abs(np.delete(z - expected, 11)).max() < 0.02
    assert abs(z[11] - expected[11]) < 0.08
    deviation = np.sqrt(tracking.covariance[:, 2, 2])
    assert deviation[11] > 3 * np.delete(deviation, [0, 11]).max()


def test_frames_that_a_recorder_repeats_are_where_their_image_is(sweep, curves):
    short, rows = sweep.part(0, 16), np.repeat(np.arange(16), 3)
    time_s = short.frame_time_s[rows] + np.tile([0.0, 0.01, 0.02], 16)
    triple = replace(short, frames=frames_of(short)[rows], frame_time_s=time_s, truth=None)
    whole, tracking = track(short, curves), track(triple, curves)
    assert np.flatnonzero(tracking.flags == 0).tolist() == list(range(0, 48, 3))
    z, expected = (t.image.apply(sweep.grid.centre_mm)[:, 2] for t in (tracking, whole))
    assert np.abs(z - expected[rows]).max() < 0.03
    assert tracking.covariance[-1, 2, 2] < 1.2 * whole.covariance[-1, 2, 2]


def test_an_image_one_patch_wide_has_the_length_of_the_whole(sweep, curves):
    """Places along a line do not determine roll: motion along x must not read as elevation for that."""
    narrow = Config.model_validate({"patches": {"region": f"rectangle 2,2 6,{sweep.grid.depth_mm}"}})
    paths = sweep.truth, track(sweep.part(0, 24), curves, narrow).image
    true, estimate = (path[0].inv() * path[23] for path in paths)
    centre = sweep.grid.centre_mm
    assert estimate.apply(centre)[2] == pytest.approx(true.apply(centre)[2], rel=0.05)


def test_curves_beside_a_recording_are_taken_and_said(data_folder):
    sweep = load_sweep(data_folder / "phantom.h5").part(0, 12)
    with pytest.warns(UserWarning, match=r"curves\.h5, by phantom; .* % \(95 %\)"):
        tracking = track(sweep)
    expected = track(sweep, read_curves(data_folder / "curves.h5"))
    np.testing.assert_array_equal(tracking.image.as_matrix(), expected.image.as_matrix())
    with pytest.raises(InvalidInputError, match="load_curves"):
        track(replace(sweep, path=None))
