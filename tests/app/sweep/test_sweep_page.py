"""The sweep player as a browser shows it."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from browsers import chromium, needs_browser, opened, viewing
from scipy.spatial.transform import RigidTransform

from speckle3d.app.sweep.screen import ScreenImages
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.study.job import run_job

pytestmark = needs_browser

LIFTED = slice(30, 35)


@pytest.fixture(scope="module")
def files(sweep, curves, tmp_path_factory):
    """48 frames, the probe lifted in five of them, a tracker that jumps and comes back; and its poses."""
    folder = tmp_path_factory.mktemp("player")
    part = sweep.part(0, 48)
    frames = np.stack([part.frames[k] for k in range(len(part))])
    noise = np.random.default_rng(2).normal(0.0, 3.5, frames[LIFTED].shape)
    frames[LIFTED] = np.rint(noise)
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
def page(files):
    recording, reconstruction = files
    with viewing(recording, "--reconstruction", reconstruction) as address, chromium() as browser:
        page = opened(browser, address)
        page.set_default_timeout(20_000)
        page.own = address.split("?")[0]
        page.get_by_text("Frame 0", exact=True).wait_for()
        yield page
        assert page.complaints == []
        assert [each for each in page.requests if not each.startswith(page.own)] == []


@pytest.fixture(autouse=True)
def from_the_first(page):
    page.keyboard.press("Home")
    at(page, 0)


def at(page, frame):
    page.get_by_text(f"Frame {frame}", exact=True).wait_for()


def shown(page):
    """The image that the browser holds, shape (row, column)."""
    held = page.evaluate(
        """() => {
          const [image] = Bokeh.documents[0].get_model_by_name("sweep image").data.image
          return {shape: image.shape, values: Array.from(image)}
        }"""
    )
    return np.array(held["values"], dtype=np.uint8).reshape(held["shape"])


def test_keys_step_leap_and_end_wherever_the_focus_is(page, files):
    page.keyboard.press("ArrowRight")
    at(page, 1)
    page.keyboard.press("Shift+ArrowRight")
    at(page, 11)
    images = ScreenImages(load_sweep(files[0]))
    np.testing.assert_array_equal(shown(page), images.image(11))
    page.get_by_text("patches in the consistent subset").wait_for()
    # On a button, which Space would press, and on a slider, which arrows would move.
    page.get_by_role("button", name="none").focus()
    page.keyboard.press("End")
    at(page, 47)
    page.locator(".noUi-handle").first.focus()
    page.keyboard.press("ArrowLeft")
    at(page, 46)
    page.keyboard.press("PageUp")
    at(page, 36)


def test_in_a_text_field_keys_write(page):
    page.evaluate("document.body.insertAdjacentHTML('beforeend', '<input id=note style=\"position:fixed\">')")
    page.locator("#note").focus()
    for key in ("a", " ", "ArrowLeft", "b"):
        page.keyboard.press(key)
    assert page.locator("#note").input_value() == "ab "
    page.evaluate("document.getElementById('note').remove()")
    page.keyboard.press("ArrowRight")
    at(page, 1)


def test_the_slider_moves_the_frame(page):
    bar = page.locator(".noUi-connects").last.bounding_box()
    page.mouse.click(bar["x"] + bar["width"] / 2, bar["y"] + bar["height"] / 2)
    page.get_by_text("Frame 0", exact=True).wait_for(state="detached")
    middle = page.locator("b", has_text="Frame ").first.inner_text()
    assert abs(int(middle.split()[1]) - 23) <= 2


def test_patches_of_a_pair_are_counted_as_the_file_has_them(page, files):
    pairs = read_reconstruction(files[1]).pairs
    page.keyboard.press("Shift+ArrowRight")
    at(page, 10)
    page.get_by_role("button", name="distance").click()
    page.get_by_text("With frame 9").wait_for()
    row = int(np.flatnonzero((pairs.first == 9) & (pairs.second == 10))[0])
    used, known = pairs.used[row], np.isfinite(pairs.distance_mm[row])
    page.get_by_text(f"{used.sum()} patches in the consistent subset").wait_for()
    page.get_by_text(f"{(known & ~used).sum()} rejected: the sensed orientation").wait_for()
    page.locator("select").first.select_option(label="frame 8 (2 before)")
    page.get_by_text("With frame 8").wait_for()
    moved = abs((pairs.first_from_second[(pairs.first == 8) & (pairs.second == 10)][0] @ centre(files))[2])
    page.get_by_text(f"{moved:.3f} ± ").wait_for()
    page.get_by_role("button", name="none").click()
    page.get_by_text("With frame 8").wait_for(state="detached")


def centre(files):
    return np.append(load_sweep(files[0]).grid.centre_mm, 1.0)


def test_what_the_checks_found_leads_to_its_frames_which_say_why(page, files):
    flagged = np.count_nonzero(read_reconstruction(files[1]).trust.flags)
    page.get_by_text(f"{flagged} of 48 frames flagged").wait_for()
    summary = json.loads((files[1].parent / "summary.json").read_text())["sweeps"][0]
    (doubt,) = [each for each in summary["doubts"] if each["suspect"] == "spikes"]
    ((first, last),) = doubt["frames"]
    name = f"frame {first}" if first == last else f"frames {first}–{last}"
    page.get_by_role("button", name=name, exact=True).click()
    at(page, first)
    page.keyboard.press("Home")
    for _ in range(3):
        page.keyboard.press("PageDown")
    at(page, LIFTED.start)
    page.get_by_text("lifted: no contact").wait_for()
    page.get_by_text("unmatched: no earlier frame").wait_for()


def test_space_plays_at_the_recordings_rate(page):
    page.keyboard.press(" ")
    page.get_by_role("button", name="pause").wait_for()
    at(page, 47)
    page.get_by_role("button", name="play").wait_for()
    page.keyboard.press("Home")
    at(page, 0)
    page.keyboard.press(" ")
    began = time.monotonic()
    page.wait_for_timeout(1000)
    page.keyboard.press(" ")
    page.get_by_role("button", name="play").wait_for()
    took = time.monotonic() - began
    frame = int(page.locator("b", has_text="Frame ").first.inner_text().split()[1])
    # No faster than 25 frames a second; how much slower is the machine's affair.
    assert 1 <= frame <= 25 * took + 2
