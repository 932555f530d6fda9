"""What tests of the pages of phantoms do in the browser, and the command that a saved report names."""

import re
import shlex
import subprocess
import sys

_WHERE = """name => {
    const figure = Bokeh.documents[0].get_model_by_name(name)
    const view = Bokeh.index.find_one(figure), at = view.el.getBoundingClientRect(), box = view.frame.bbox
    return {x: at.x + box.left, y: at.y + box.top, width: box.width, height: box.height,
            columns: [figure.x_range.start, figure.x_range.end],
            rows: [figure.y_range.start, figure.y_range.end]}
}"""


def place(page, column, row, name="picture"):
    """Where on the screen a figure shows a place."""
    at = page.evaluate(_WHERE, name)
    (left, right), (bottom, top) = at["columns"], at["rows"]
    share = (column - left) / (right - left), (row - top) / (bottom - top)
    return at["x"] + share[0] * at["width"], at["y"] + share[1] * at["height"]


def text_match(page, name, pattern):
    """Wait until the page says something, a pattern; returns its match."""
    regex = re.compile(pattern)
    where = page.locator(f".{name}")
    where.filter(has_text=regex).first.wait_for()
    return regex.search(where.inner_text())


def run_and_save(page, name):
    """Run the calibration and save it; returns the table that the page shows."""
    page.get_by_role("button", name="Run calibration").click()
    page.locator("pre.calibration").wait_for()
    page.wait_for_timeout(300)
    field = page.get_by_label("file of the result")
    field.fill(name)
    field.press("Enter")
    page.get_by_role("button", name="Save result").click()
    page.get_by_text(f"Saved {name}").wait_for()
    return page.locator("pre.calibration").inner_text()


def by_command(result, out):
    """What the command that a saved calibration's report names writes elsewhere, and prints."""
    line = result.with_suffix(".txt").read_text().split("made by: ")[1].strip()
    words = shlex.split(line)
    assert words[0] == "speckle3d"
    words[words.index("-o") + 1] = str(out)
    command = [sys.executable, "-m", "speckle3d.cli", *words[1:]]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert process.returncode == 0, process.stderr
    return process.stdout.split("made by: ")[0].strip()
