"""The page and its parts: the study's facts, names escaped, plots of what was measured."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from report_examples import HOSTILE, MODES, REASON

from speckle3d.core.text import printable
from speckle3d.report.data import load_view
from speckle3d.report.page import write_report
from speckle3d.study.figures import label_of
from speckle3d.study.results import Study


class Page(HTMLParser):
    """The page without its scripts: tags, addresses and words."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.addresses, self.words, self._open = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self._open.append(tag)
        self.addresses += [value for name, value in attributes if name in ("src", "href", "action", "data")]

    def handle_endtag(self, tag):
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data):
        if not {"script", "style"} & set(self._open):
            self.words.append(data)


@pytest.fixture(scope="module")
def text(report_study):
    return (report_study.directory / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def test_the_page_stands_alone(page, text):
    assert page.addresses
    assert all(address.startswith(("data:image/", "#")) for address in page.addresses)
    (policy,) = [a["content"] for t, a in page.tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "'unsafe-inline'" not in policy.split("script-src")[1].split(";")[0]
    # The library is 5 MB; a megabyte for each sweep keeps a study of eleven under 16 MB.
    assert len(text.encode()) < 5.0e6 + 2 * 1.0e6


def test_every_number_is_in_the_tables_and_what_is_broken_or_in_doubt_stands_above(page, text, report_study):
    words = " ".join(page.words)
    for row in report_study.rows:
        if np.isfinite(row["tilt_error_deg"]):
            assert f"{row['length_error_mm']:+.2f}" in words
            assert f"{row['tilt_error_deg']:+.2f}" in words
    assert words.index(printable(REASON)) < words.index("Errors by sweep and part")
    for text_part in ("GPE / mm", "12.3", "1.0 [0.5, 1.5]", "+11.1 [+2.1, +20.0]", "image − pose"):
        assert text_part in words
    # What is printed is spelt out.
    assert re.search("FDR +final drift rate", words)
    place = text.index('id="doubts"')
    assert place < text.index('id="modes"')
    doubts = text[place : text.index("</table>", place)]
    assert all(part in doubts for part in ("units &lt;in&gt; metres", "expected 3 mm, got 0.003", "refused"))
    assert 'href="#sweep-1"' in doubts


def test_names_and_reasons_of_others_are_text(text, page):
    assert HOSTILE not in text
    assert "&lt;three&gt; axes &amp; more" in text
    # What drives a terminal or turns the direction of writing is shown; the scripts of plotly have their own.
    assert r"got \x1b[31mnone\u202e" in text
    assert not {"\x1b", "\u202e"} & set(text.partition("<script>")[0])
    assert page.words.count(HOSTILE) >= 2 + len(MODES)
    # The two of the page, and the data of three plots for each sweep.
    scripts = [a.get("type") for tag, a in page.tags if tag == "script"]
    assert scripts == ["application/json"] * 6 + [None, None]


def test_plots_hold_the_curves_and_the_tracker_alone(text, report_study):
    traces = json.loads(re.search(r'id="plot-sweep-1-curves">(.*?)</script>', text)[1])["data"]
    view = load_view(report_study.directory, report_study.successes[0])
    for mode in ("pose", "tracker"):
        (trace,) = [t for t in traces if t["name"] == label_of(mode) and t["visible"] and t["xaxis"] == "x"]
        values = np.frombuffer(base64.b64decode(trace["y"]["bdata"]), np.dtype(trace["y"]["dtype"]))
        np.testing.assert_allclose(values, view.curves.modes[mode][0], rtol=1e-6, atol=1e-6)
    pictures = re.findall(r'<img[^>]* src="data:image/png;base64,([^"]+)"', text)
    assert [base64.b64decode(picture)[:4] for picture in pictures] == [b"\x89PNG"] * 5


def test_a_sweep_whose_file_is_gone_or_changed_is_shown_without_its_reference(page, report_study, tmp_path):
    assert str(report_study.directory / "gone.h5") in " ".join(page.words)
    new_file = tmp_path / "forward.h5"
    new_file.write_bytes(b"another")
    view = load_view(report_study.directory, replace(report_study.successes[0], path=new_file))
    assert view.curves.reference is None
    assert any(str(new_file) in note for note in view.notes)


def test_a_study_of_broken_sweeps_alone_is_still_a_page(report_study, tmp_path):
    failure = report_study.failures[0]
    success = replace(report_study.successes[0], folder="sweeps/lost-1")
    words = " ".join(
        Page(write_report(Study(tmp_path, [failure, success], "")).read_text(encoding="utf-8")).words
    )
    assert printable(failure.reason) in words
    # The sweep whose folder is gone is told with it.
    assert str(tmp_path / "sweeps" / "lost-1") in words
