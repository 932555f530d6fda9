"""The reconstruction viewer as a browser meets it, against the commands that it shows."""

import io
import shlex
import sys
from contextlib import chdir, redirect_stdout, suppress

import numpy as np
import pytest
from browsers import needs_browser, opened, viewing
from matplotlib.image import imread

from speckle3d import cli
from speckle3d.study.figures import label_of

pytestmark = needs_browser

PLOT = """([name, x, y]) => {
  const view = Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name(name))
  const box = view.canvas_view.el.getBoundingClientRect()
  return [box.left + view.frame.x_scale.compute(x), box.top + view.frame.y_scale.compute(y)]
}"""
PLOT_OF = "Bokeh.documents[0].get_model_by_name(name)"
HANDLES = f"""name => {PLOT_OF}.center.filter(each => each.movable && each.visible)
  .map(each => [(each.left + each.right) / 2, (each.top + each.bottom) / 2])"""
IMAGE = f"name => {PLOT_OF}.renderers[0].data_source.data.image[0].toString()"
TITLE = f"name => {PLOT_OF}.title.text"


def speckle3d(*arguments):
    """Run a command in this process, and return what it said."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said):
        patch.setattr(sys, "argv", ["speckle3d", *map(str, arguments)])
        with suppress(SystemExit):
            cli.main()
    return said.getvalue()


@pytest.fixture(scope="module")
def results(shipped, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results") / "made"
    speckle3d("reconstruct", shipped / "phantom.h5", "-o", folder, "--frames", "0-39", "--drift", "pose")
    return folder


@pytest.fixture(scope="module")
def page(browser, results):
    with viewing(results) as address:
        page = opened(browser, address)
        page.address = address
        page.wait_for_function(f"() => window.Bokeh && {drawn('free')}")
        yield page
        assert page.complaints == []


def drawn(name):
    """Whether a cut is shown as it is from the frames."""
    title = f"Bokeh.documents[0]?.get_model_by_name('cut-{name}')?.title.text"
    return f"(t => t && !t.includes('voxels') && !t.includes('making'))({title})"


def at_rest(page, name="free"):
    page.wait_for_timeout(800)
    page.wait_for_function(f"() => {drawn(name)}")


def drag(page, plot, handle, by_px):
    x, y = page.evaluate(PLOT, [plot, *page.evaluate(HANDLES, plot)[handle]])
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + by_px[0], y + by_px[1], steps=5)
    page.mouse.up()


def shown_command(page, tab):
    page.get_by_text(tab, exact=True).first.click()
    return shlex.split(
        page.get_by_text("speckle3d " + {"measure": "measure", "save": "reslice"}[tab]).inner_text()
    )


def test_it_asks_nobody_else(page):
    own = page.address.split("?")[0]
    assert [each for each in page.requests if not each.startswith(own)] == []


@pytest.mark.parametrize("handle", [0, 1])
def test_a_dragged_plane_is_cut_where_it_is(page, results, handle):
    before = page.evaluate(IMAGE, "cut-free"), page.evaluate(TITLE, "cut-free")
    drag(page, "cut-depth", handle, (25, 15))
    # The server answers late where it compiles a kernel first.
    page.wait_for_function(f"before => ({IMAGE})('cut-free') !== before", arg=before[0])
    at_rest(page)
    assert page.evaluate(TITLE, "cut-free") != before[1]


@pytest.mark.parametrize("other", [None, label_of("pose")])
def test_the_saved_picture_is_what_the_command_makes(page, results, other):
    if other:
        page.get_by_text("cuts", exact=True).first.click()
        page.get_by_label("compared with").select_option(label=other)
        at_rest(page)
    command = shown_command(page, "save")
    name = f"seen-{bool(other)}.png"
    page.get_by_label("file").fill(name)
    page.get_by_label("file").press("Enter")
    page.get_by_role("button", name="save the picture").click()
    page.get_by_text(f"saved {name}").wait_for()
    command[command.index("-o") + 1] = "again.png"
    assert ("--difference-to" in command) == bool(other)
    with chdir(results):
        speckle3d(*command[1:])
    assert (results / "again.png").read_bytes() == (results / name).read_bytes()
    assert np.ptp(imread(results / name)) > 0


def test_points_measure_as_the_command_has_it(page, results):
    for x, y in ((1.0, 10.0), (3.0, 30.0), (3.5, 12.0)):
        page.mouse.click(*page.evaluate(PLOT, ["cut-along", x, y]))
        page.wait_for_timeout(700)  # two clicks at once are a double one
    page.get_by_text("angle 1 2 3").wait_for()
    command = shown_command(page, "measure")
    with chdir(results):
        said = speckle3d(*command[1:]).splitlines()
    assert len(said) == 5
    for line in said:
        assert page.get_by_text(line, exact=True).count() == 1


def test_a_click_beside_the_sweep_says_so(page):
    page.mouse.click(*page.evaluate(PLOT, ["cut-along", -4.0, 10.0]))
    page.get_by_text("expected a point in the sweep").wait_for()
