"""The sweep player, without a browser and in one."""

from dataclasses import replace

import numpy as np
import pytest
from browsers import needs_browser, open_page, viewing
from scipy.spatial.transform import RigidTransform

from speckle3d.app.sweep.page import SweepPage, _Player
from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.io.family.reconstructions import read_reconstruction
from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.load import load_sweep
from speckle3d.study.job import run_job
from speckle3d.study.results import recorded_doubts

NO_CONTACT = slice(30, 32)


@pytest.fixture(scope="module")
def files(sweep, curves, tmp_path_factory):
    """48 frames, the probe lifted in two of them, a tracker that jumps and comes back; and its poses."""
    folder = tmp_path_factory.mktemp("player")
    part = sweep.part(0, 48)
    frames = np.stack([part.frames[k] for k in range(len(part))])
    noise = np.random.default_rng(2).normal(0.0, 3.5, frames[NO_CONTACT].shape)
    frames[NO_CONTACT] = np.rint(noise)
    readings = part.tracker.readings
    poses = readings.world_from_sensor.as_matrix()
    # Less than what no hand does, which is left out as the file is read.
    poses[60:62, :3, 3] += 5.0
    tracker = replace(
        part.tracker, readings=replace(readings, world_from_sensor=RigidTransform.from_matrix(poses))
    )
    write_sweep(folder / "lifted.h5", replace(part, frames=frames, tracker=tracker))
    run_job(load_sweep(folder / "lifted.h5"), folder / "lifted.h5", curves, folder / "results")
    return folder / "lifted.h5", folder / "results" / "reconstruction.h5"


@pytest.fixture(scope="module")
def reconstruction(files):
    return read_reconstruction(files[1])


@pytest.fixture
def player(files, reconstruction):
    doubts = recorded_doubts(files[1], reconstruction.provenance)
    player = _Player(SweepPage(load_sweep(files[0]), reconstruction, doubts))
    player.layout()
    return player


def text(player):
    return player._text.object


def test_a_sample_lies_where_the_axes_say():
    x, y = np.meshgrid(np.arange(8), np.arange(1500), indexing="ij")
    frames = np.where((x == 5) & (abs(y - 900) < 40), 255, 0)[None].astype(np.uint8)
    grid = ImageGrid(8, 1500, 0.5, 0.02, 1.0)
    page = SweepPage(Sweep(np.repeat(frames, 2, axis=0), grid, BModeSettings(90.0), np.arange(2.0)))
    rows, columns = np.nonzero(page.image(1) > -20.0)
    (_, first_mm), (_, row_mm) = page.place
    assert set(columns) == {5}
    assert first_mm + rows.mean() * row_mm == pytest.approx(19.0, abs=0.03)


def test_patches_of_a_pair_are_counted_as_the_file_has_them(player, reconstruction):
    player.param.update(frame=10, colour="distance", lag=-2)
    pairs = reconstruction.pairs
    row = int(np.flatnonzero((pairs.first == 8) & (pairs.second == 10))[0])
    inliers, has_distance = pairs.used[row], np.isfinite(pairs.distance_mm[row])
    assert f"{inliers.sum()} patches used, {(has_distance & ~inliers).sum()} left out" in text(player)
    assert f"{abs(pairs.first_from_second[row] @ centre(player))[2]:.3f} mm away" in text(player)
    patches = player._picture._patches.data
    np.testing.assert_array_equal(patches["value"], pairs.distance_mm[row])
    assert np.count_nonzero(patches["cross"]) == (has_distance & ~inliers).sum()


def centre(player):
    return np.append(player._page.sweep.grid.centre_mm, 1.0)


def test_flags_and_doubts_are_marked_at_their_frames_and_a_click_goes_there(player, reconstruction):
    count = np.count_nonzero(reconstruction.trust.flags)
    assert f"{count} of 48 frames flagged" in text(player)
    player.frame = NO_CONTACT.start
    assert "lifted: no contact" in text(player)
    marks = player._times.marks.renderers[0].data_source.data
    (spikes,) = (at for at, words in enumerate(marks["words"]) if "(suspect: spikes)" in words)
    tracker = player._page.sweep.tracker
    assert (
        marks["left"][spikes] < tracker.readings.time_s[60] + tracker.time_offset_s < marks["right"][spikes]
    )
    player._times._go(marks["left"][spikes])
    assert player._times.cursor.location == pytest.approx(marks["left"][spikes], abs=0.04)


@pytest.mark.slow
@needs_browser[1]
@needs_browser[2]
def test_in_the_browser_it_plays_and_the_image_fills_the_height(browser, files):
    recording, reconstruction = files
    with viewing(recording, "--reconstruction", reconstruction) as address:
        page = open_page(browser, address)
        page.set_default_timeout(30_000)
        page.get_by_text("of 0 to 47").wait_for()
        plot = page.locator(".bk-Figure").first.bounding_box()
        assert plot["height"] > 650
        assert plot["y"] + plot["height"] <= 768
        slider = page.locator("input[type=range]").first
        slider.focus()
        page.keyboard.press("ArrowRight")
        page.get_by_text("Frame 1", exact=True).wait_for()
        page.locator("button.play").click()
        page.get_by_text("Frame 47", exact=True).wait_for()
        assert page.complaints == []
        assert [url for url in page.requests if not url.startswith(address.split("?")[0])] == []
        page.close()
