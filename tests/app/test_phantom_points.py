"""Points of N-wires found, moved, deleted and added with the mouse, saved, and calibrated with."""

import numpy as np
import pytest
from browsers import needs_browser, open_page, viewing
from phantom_pages import place, text_match
from phantom_recordings import wire_recording

from speckle3d.io.points import read_points

pytestmark = needs_browser


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wires")
    return folder / "wires.h5", wire_recording(folder / "wires.h5", folder / "wires.xml")


@pytest.fixture(scope="module")
def page(browser, recording):
    path = recording[0]
    with viewing(path, "--calibrate", "wires", "--phantom", path.with_suffix(".xml")) as address:
        page = open_page(browser, address)
        page.locator(".phantom-told").wait_for()
        page.get_by_role("button", name="Find points in all frames").click()
        text_match(page, "phantom-told", r"in \d+ frames")
        page.set_default_timeout(30_000)
        yield page
        assert page.complaints == []


def save_points(page, path, name):
    field = page.get_by_label("file of the points")
    field.fill(name)
    field.press("Enter")
    page.get_by_role("button", name="Save points").click()
    page.get_by_text(name).last.wait_for()
    return read_points(path.with_name(name), tuple("abcdefghi"))


def test_points_are_found_moved_deleted_and_added_by_mouse(page, recording):
    path, scene = recording
    text_match(page, "phantom-told", "frame 0: 9 points")
    points = save_points(page, path, "found.csv")
    away = points.pixels - scene.pixels[points.frame, points.wire]
    assert np.abs(away).max() < 2.0
    first = points.pixels[0]
    page.mouse.move(*place(page, *first))
    page.mouse.down()
    page.mouse.move(*place(page, first[0] + 30, first[1] - 12), steps=5)
    page.mouse.up()
    page.wait_for_timeout(400)
    page.mouse.click(*place(page, *points.pixels[1]))
    page.wait_for_timeout(400)
    page.keyboard.press("Backspace")
    text_match(page, "phantom-told", "frame 0: 8 points; none on b")
    edit = save_points(page, path, "changed.csv")
    assert edit.pixels[0] == pytest.approx(first + np.array([30, -12]), abs=1.5)
    assert 1 not in edit.wire[edit.frame == 0]
    # The wire that is missing is the next one.
    page.mouse.click(*place(page, *first))
    text_match(page, "phantom-told", "frame 0: 9 points")
    again = save_points(page, path, "again.csv")
    assert again.pixels[(again.frame == 0) & (again.wire == 1)][0] == pytest.approx(first, abs=1.5)
