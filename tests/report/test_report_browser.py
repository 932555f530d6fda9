"""The report as a person meets it: opened, clicked through and printed in a browser without a window."""

import pytest
from browsers import chromium, needs_browser

pytestmark = needs_browser

VISIBLE = "element => element.getClientRects().length > 0"


@pytest.fixture(scope="module")
def report(report_study):
    return report_study.directory / "report.html"


@pytest.fixture(scope="module")
def browser():
    with chromium() as window:
        yield window


@pytest.fixture(scope="module")
def page_of_study(browser, report):
    """The page in a browser, and what it complained of and asked for."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    # Slow machines draw in software.
    page.set_default_timeout(60_000)
    page.complaints, page.requests = [], []
    page.on("console", lambda m: page.complaints.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.on("request", lambda r: page.requests.append(r.url) if not r.url.startswith("data:") else None)
    page.goto(report.as_uri())
    page.wait_for_selector("#sweep-1 figure.drawn .legend")
    yield page
    page.close()


def shows(page, selector):
    return [element.evaluate(VISIBLE) for element in page.query_selector_all(selector)]


def test_it_opens_without_complaint_or_network(page_of_study, report):
    assert page_of_study.complaints == []
    assert page_of_study.requests == [report.as_uri()]
    assert page_of_study.locator(".lead").bounding_box()["y"] < 200
    # What is wider than the screen scrolls by itself.
    assert page_of_study.evaluate("document.documentElement.scrollWidth") <= 1280
    assert len(page_of_study.query_selector_all("#sweep-1 figure.drawn canvas")) > 0


def test_clicking_chooses_sweeps_and_differences(page_of_study):
    curves = '#sweep-1 figure[data-plot$="curves"] .plot'
    before = page_of_study.eval_on_selector(curves, "plot => plot.data.map(trace => trace.visible)")
    page_of_study.click(f"{curves} .updatemenu-button >> text=minus truth")
    page_of_study.wait_for_function(f"document.querySelector('{curves}').data[0].visible === false")
    after = page_of_study.eval_on_selector(curves, "plot => plot.data.map(trace => trace.visible)")
    assert after == [not visible for visible in before]

    page_of_study.click("#chooser button >> text=alert")
    assert shows(page_of_study, ".sweep") == [False, True]
    assert any("gone.h5" in note for note in page_of_study.locator("#sweep-2 .note").all_inner_texts())
    assert page_of_study.query_selector_all("#sweep-1 canvas") == []

    page_of_study.keyboard.press("ArrowLeft")
    assert shows(page_of_study, ".sweep") == [True, False]
    page_of_study.click("#parts ~ .wide a >> text=alert >> nth=0")
    assert shows(page_of_study, ".sweep") == [False, True]

    assert not page_of_study.locator("pre").is_visible()
    page_of_study.click("summary")
    assert page_of_study.locator("pre").is_visible()
    assert page_of_study.complaints == []


def test_without_scripts_tables_and_pictures_are_there_and_it_says_what_is_not(browser, report):
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.set_default_timeout(60_000)
    page.goto(report.as_uri())
    assert page.locator(".sweep").count() == 2
    assert all(image.is_visible() for image in page.locator("figure img").all())
    assert page.locator("noscript").first.is_visible()
    context.close()
