"""The tuner of line detection as somebody uses it: what the sliders, the mouse and the button do."""

import pytest
from browsers import needs_browser, open_page, viewing
from phantom_pages import by_command, place, run_and_save, text_match
from phantom_recordings import MEMBRANE_MM, PIXEL_MM, floor_recording

from speckle3d.io.family.calibrations import read_calibration

pytestmark = needs_browser


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("floor") / "floor.h5"
    return path, floor_recording(path)


@pytest.fixture(scope="module")
def page(browser, recording):
    with viewing(recording[0], "--calibrate", "plane") as address:
        page = open_page(browser, address)
        page.locator(".phantom-told").wait_for()
        page.set_default_timeout(30_000)
        yield page
        assert page.complaints == []


def handle(page, number):
    """Of the sliders, in the order of the page: frame, n, sigma, T, d, p."""
    return page.locator(".noUi-handle").nth(number)


def test_a_region_drawn_with_the_mouse_changes_the_line(page, recording):
    row = recording[1][0]
    above = row - MEMBRANE_MM / PIXEL_MM[1]
    text_match(page, "phantom-told", f"row {int(above)}")
    # A box about the middle that leaves the membrane out.
    top = above + MEMBRANE_MM / PIXEL_MM[1] / 2
    start, end = place(page, 104, top), place(page, 184, 285)
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=4)
    page.mouse.up()
    region = page.get_by_label("region")
    page.wait_for_function("field => field.value", arg=region.element_handle())
    places = [tuple(map(float, corner.split(","))) for corner in region.input_value().split()]
    assert places == [pytest.approx(at, abs=1.0) for at in ((104, top), (184, top), (184, 285), (104, 285))]
    text_match(page, "phantom-told", f"row {int(row)}")
    region.fill("")
    region.press("Enter")
    text_match(page, "phantom-told", f"row {int(above)}")


def test_the_calibration_is_the_commands_to_the_last_digit(page, recording, tmp_path):
    region = page.get_by_label("region")
    region.fill("12.5,20 280,20 280,289 12.5,289")
    region.press("Enter")
    for _ in range(2):
        handle(page, 1).press("ArrowLeft")
    handle(page, 2).press("ArrowRight")
    text_match(page, "phantom-told", "of 58 columns agree")
    # A double click on the strip leaves a frame out; the first shows the membrane, not the floor.
    page.mouse.dblclick(*place(page, 0, 0.5, "strip"))
    page.wait_for_timeout(500)
    assert page.get_by_label("leave out").input_value() == "0"
    page.get_by_label("leave out").fill("0,7")
    page.get_by_label("leave out").press("Enter")
    page.get_by_role("button", name="Run calibration").click()
    page.get_by_text("say first what the plane is").wait_for()
    page.get_by_label("what the plane is").select_option(label="a bare wall")
    page.wait_for_timeout(300)
    table = run_and_save(page, "tuned.h5")
    assert "left out by hand" in table
    file = recording[0].with_name("tuned.h5")
    line = file.with_suffix(".txt").read_text().split("made by: ")[1]
    for option in ("--columns 58", "--smoothing-mm 0.75", "--leave-out 0,7", "--region '12.5,20 280,20"):
        assert option in line
    out = tmp_path / "again.h5"
    assert by_command(file, out) == table.strip()
    tuned, again = read_calibration(file), read_calibration(out)
    assert (tuned.parameters, tuned.frames) == (again.parameters, again.frames)
    assert not {0, 7} & {*tuned.frames.used}
    assert tuned.pixel_mm == pytest.approx(PIXEL_MM, rel=0.01)
    # What changes while a calibration runs is not what it was made with.
    page.get_by_role("button", name="Run calibration").click()
    page.get_by_label("leave out").fill("0")
    page.get_by_label("leave out").press("Enter")
    page.get_by_text("Settings changed").wait_for()
    page.wait_for_timeout(3000)
    assert page.get_by_role("button", name="Save result").is_disabled()
