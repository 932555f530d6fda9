"""The reconstruction viewer as a browser shows it."""

import numpy as np
import pytest
from browsers import needs_browser, open_page, viewing

from speckle3d.io.family.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.study.job import run_job

pytestmark = needs_browser

PLACE = """([name, x, y]) => {
  const view = Bokeh.index.find_one(Bokeh.documents[0].get_model_by_name(name))
  const box = view.canvas_view.el.getBoundingClientRect()
  return [box.left + view.frame.x_scale.compute(x), box.top + view.frame.y_scale.compute(y)]
}"""
TITLE = "name => Bokeh.documents[0]?.get_model_by_name(name)?.title.text"


@pytest.fixture(scope="module")
def page(browser, small_sweeps, tmp_path_factory):
    folder, path = tmp_path_factory.mktemp("results"), small_sweeps / "s5.h5"
    run_job(load_sweep(path), path, read_curves(small_sweeps / "curves.h5"), folder / "made")
    with viewing(folder / "made") as address:
        page = open_page(browser, address)
        page.wait_for_function(f"() => window.Bokeh && ({TITLE})('cut-depth')")
        page.get_by_text("depth / mm").first.wait_for()
        page.set_default_timeout(20_000)
        yield page
        assert page.complaints == []
        assert [url for url in page.requests if not url.startswith(address.split("?")[0])] == []


def click(page, cut, x, y):
    page.wait_for_timeout(700)  # two clicks at once are a double one
    page.mouse.click(*page.evaluate(PLACE, [cut, x, y]))


def test_a_click_moves_the_other_cuts_and_measures_its_points(page):
    before = page.evaluate(TITLE, "cut-frame"), page.evaluate(TITLE, "cut-depth")
    for x, y in ((0.6, 3.0), (2.0, 9.0)):
        title = page.evaluate(TITLE, "cut-depth")
        click(page, "cut-along", x, y)
        page.wait_for_function(f"before => ({TITLE})('cut-depth') !== before", arg=title)
        page.get_by_role("button", name="Add the point").click()
        page.wait_for_timeout(300)
    after = page.evaluate(TITLE, "cut-frame"), page.evaluate(TITLE, "cut-depth")
    assert all(np.array(before) != np.array(after))
    page.get_by_text("distance 1 2").wait_for()
