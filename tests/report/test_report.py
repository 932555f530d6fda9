import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from report_examples import MODES, REASON, small_study
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.reconstruction import FramePairs
from speckle3d.core.sweep import ImageGrid
from speckle3d.report.data import SweepCurves, load_view, read_study, rejected_patches
from speckle3d.report.figures import MOST_POINTS, decimated, outline, patch_size
from speckle3d.report.html import heading_of, records_table
from speckle3d.report.page import write_report
from speckle3d.report.plots import plot_curves, plot_rejected
from speckle3d.report.reslices import cut_modes
from speckle3d.report.statistics import (
    Scored,
    intervals_table,
    paired_table,
    scored_means,
    summary_lines,
)
from speckle3d.study.overall import over_sweeps


@pytest.fixture(scope="module")
def study(tmp_path_factory, shipped):
    return small_study(tmp_path_factory.getbasetemp() / "report-study", shipped / "curves.h5")


@pytest.fixture(scope="module")
def text(study):
    return write_report(study).read_text(encoding="utf-8")


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
def page(text):
    return Page(text)


def scored(**length_percent):
    means = [
        {"mode": mode, "sweeps": 2, "length_mm": 0.1 * value, "length_percent": value,
         "tilt_deg": 0.3 / value, "yaw_deg": 0.0, "roll_deg": 0.0}
        for mode, value in length_percent.items()
    ]  # fmt: skip
    return Scored(means, 2)


def part_rows(**errors):
    """Rows by sweep and mode from the errors of their parts; ``a_image=[1.0, 3.0]``."""
    return [
        {"sweep": name.split("_")[0], "mode": name.split("_")[1], "part": part, "length_error_percent": error,
         "length_error_mm": 0.1 * error, "tilt_error_deg": 1.0, "yaw_error_deg": 0.0, "roll_error_deg": 0.0}
        for name, values in errors.items() for part, error in zip("fr", values, strict=False)
    ]  # fmt: skip


def test_the_page_stands_alone(page, text):
    assert page.addresses
    assert all(address.startswith(("data:image/", "#")) for address in page.addresses)
    (policy,) = [a["content"] for t, a in page.tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "'unsafe-inline'" not in policy.split("script-src")[1].split(";")[0]
    assert "@media print" in text
    # The library is 4.9 MB; 0.6 MB for each sweep keep a study of eleven under 12 MB. These two are small.
    assert len(text.encode()) < 5.0e6 + 2 * 0.4e6


def test_the_summary_comes_first_and_says_what_the_rows_say(page, study):
    rows = read_study(study)["rows"]
    assert {r["part"] for r in rows} == {"f"}
    mean = {m: np.mean([abs(r["length_error_percent"]) for r in rows if r["mode"] == m]) for m in MODES}
    best = min(mean, key=mean.get)
    words = " ".join(page.words)
    lead = words[words.index("Over 2 sweeps (2 parts), ") :]
    named = {"image": "image-based", "orientation": "orientation correction", "pose": "six DOF correction"}
    assert lead.index(named[best]) < lead.index("smallest error")
    assert f"{mean[best]:.1f} % on average" in lead
    assert words.index("Over 2 sweeps (2 parts)") < words.index("Errors by sweep and part")
    assert "1 of 3 sweeps could not be reconstructed" in words


def test_every_row_is_in_the_table_and_the_broken_sweep_with_its_reason(text, page, study):
    words = " ".join(page.words)
    for row in read_study(study)["rows"]:
        assert f"{row['length_error_mm']:+.2f}" in words
        assert f"{row['tilt_error_deg']:+.2f}" in words
    assert REASON in words
    assert "&lt;three&gt; axes &amp; more" in text
    assert "GPE / mm" in words
    assert "0.123" in words
    assert "sensors" in words[words.index("Every setting") :]


def test_a_sweep_whose_file_is_gone_is_shown_without_reference_and_reslices(page, study):
    words = " ".join(page.words)
    assert f"no longer at {study / 'gone.h5'}" in words
    figures = {path.name for path in (study / "figures").iterdir()}
    for kind in ("png", "svg"):
        assert {f"forward-0a-{f}.{kind}" for f in ("curves", "outlines", "reslices", "patches")} <= figures
        assert f"gone-0b-curves.{kind}" in figures
        assert f"gone-0b-reslices.{kind}" not in figures


def test_the_interactive_plots_hold_the_curves(text, study):
    found = re.search(r'id="plot-forward-0a-curves">(.*?)</script>', text)
    plot = json.loads(found[1].replace("<\\/", "</"))
    view = load_view(study, read_study(study)["sweeps"][0])
    (pose,) = [t for t in plot["data"] if t["name"] == "six DOF correction" and t["visible"] and
               t["xaxis"] == "x1"]  # fmt: skip
    # Rounded to three decimals.
    np.testing.assert_allclose(pose["y"], view.curves.modes["pose"][0], atol=6e-4)


def test_pictures_of_the_page_are_pictures(text):
    kinds = {"svg+xml": b"<?xml", "png": b"\x89PNG", "jpeg": b"\xff\xd8"}
    found = re.findall(r'<img[^>]* src="data:image/([^;]+);base64,([^"]+)"', text)
    # The overview, four of the sweep that is there, three of the one that is gone.
    assert len(found) == 8
    assert all(base64.b64decode(data).startswith(kinds[kind]) for kind, data in found)


def test_the_same_detail_is_cut_in_every_mode(study):
    view = load_view(study, read_study(study)["sweeps"][0])
    cuts = cut_modes(view)
    assert list(cuts.by_mode) == [*MODES, "truth"]
    details = [cut.detail for cut in cuts.by_mode.values()]
    assert len({d.shape for d in details}) == 1
    seen = np.isfinite(details).all(axis=0)
    assert seen.mean() > 0.9
    # The same frame at the same place: alike in all modes, unlike a place 0.4 mm aside.
    for other in details[:-1]:
        assert np.corrcoef(details[-1][seen], other[seen])[0, 1] > 0.6
    aside = np.roll(details[-1], 10, axis=0)
    assert np.corrcoef(details[-1][seen], aside[seen])[0, 1] < 0.4


def test_a_changed_sweep_is_not_taken_for_the_one_reconstructed(study, tmp_path):
    entry = read_study(study)["sweeps"][0]
    other = tmp_path / "forward.h5"
    other.write_bytes(b"another")
    view = load_view(study, entry | {"path": str(other)})
    assert view.sweep is None
    assert "no longer the one" in view.notes[0]


def test_without_a_reference_no_mode_is_called_right():
    (line,) = summary_lines(Scored([]), 2, 0)
    assert "no mode can be called right" in line


def test_without_any_result_the_summary_says_so():
    assert summary_lines(Scored([]), 0, 2) == [
        "Nothing could be reconstructed from 2 sweeps; the reasons are below."
    ]


def test_the_best_in_length_and_the_best_in_tilt_may_differ():
    length, tilt = summary_lines(scored(image=4.0, pose=2.0), 2, 0)
    assert length.startswith(
        "Over 2 sweeps (2 parts), six DOF correction has the smallest error of length: 2.0 %"
    )
    assert "against 4.0 % with image-based" in length
    assert tilt.startswith("In tilt image-based is closest")


def test_the_lead_means_over_sweeps_of_their_parts_as_the_tables_do():
    rows = part_rows(a_image=[1.0, -3.0], b_image=[8.0])
    found = scored_means(rows, ["image"])
    # Pooled parts would give 4.
    assert found.means[0]["length_percent"] == pytest.approx(5.0)
    assert (found.means[0]["sweeps"], found.parts) == (2, 3)
    intervals, _ = over_sweeps(rows, [])
    assert intervals[0]["mean"] == pytest.approx(5.0)
    assert "Over 2 sweeps (3 parts), image-based has the smallest" in summary_lines(found, 2, 0)[0]


def test_modes_of_different_sweeps_are_ranked_on_those_that_have_all():
    # On the hard sweep only images could be had; there they are wrong by 40 %.
    rows = part_rows(a_image=[2.0], a_pose=[3.0], hard_image=[40.0])
    found = scored_means(rows, ["image", "pose"])
    assert [row["length_percent"] for row in found.means] == [2.0, 3.0]
    line = summary_lines(found, 2, 0)[0]
    assert line.startswith("Over 1 sweep that has every mode (1 part), image-based has the smallest error")
    apart = scored_means(part_rows(a_image=[2.0], b_pose=[3.0]), ["image", "pose"])
    assert not apart.together
    assert summary_lines(apart, 2, 0)[0].startswith("No sweep was reconstructed in every mode")


def test_the_lead_says_what_the_reference_was_and_what_was_fitted_to_it():
    three = scored(image=4.0, pose=2.0)
    lines = summary_lines(three, 2, 0, [], {"a": "truth", "b": "tracker"})
    assert "References differ: truth of a; tracker of b; the means mix errors against both." in lines
    assert any("Six DOF correction was fitted to the tracker that it is compared with" in x for x in lines)
    lines = summary_lines(three, 2, 0, [], {"a": "truth", "b": "truth"})
    assert "Reference: truth." in lines
    assert not any("fitted" in line for line in lines)


def pairs(quantity, *told):
    """Three modes compared in a quantity; `told` are the pairs that are told apart."""
    modes = ("image", "orientation", "pose")
    return [
        {"quantity": quantity, "mode": a, "against": b, "better": b if (a, b) in told else None,
         "difference": 1.0, "low": -0.5, "high": 2.5}
        for i, a in enumerate(modes) for b in modes[i + 1 :]
    ]  # fmt: skip


def test_the_lead_says_where_the_best_is_not_told_apart():
    three = scored(image=4.0, orientation=3.0, pose=2.0)
    unsure, _ = summary_lines(three, 2, 0, pairs("length_error_percent"))
    assert "six DOF correction has the smallest error" in unsure
    assert unsure.endswith(
        "not told apart from the other modes by these sweeps: the difference may be chance."
    )
    some = pairs("length_error_percent", ("image", "pose"))
    half, tilt = summary_lines(three, 2, 0, some)
    assert half.endswith("It is not told apart from orientation correction: that difference may be chance.")
    assert "not told apart" in tilt
    every = pairs("length_error_percent", ("image", "pose"), ("orientation", "pose"))
    sure, _ = summary_lines(three, 2, 0, every)
    assert sure.endswith("The sweeps tell it apart from every other mode.")
    two, _ = summary_lines(scored(image=4.0, pose=2.0), 2, 0, [])
    assert "not told apart from image-based by these sweeps" in two


def test_means_and_differences_over_sweeps_are_tables(page):
    words = " ".join(page.words)
    assert "1.0 (0.5 to 1.5)" in words
    assert "+11.1% (+2.1% to +20.0%)" in words
    assert "image-based − six DOF correction" in words
    table = paired_table(pairs("FDR", ("image", "pose")))
    assert table.count("<b>") == 1
    assert "−50.0%" in table
    assert intervals_table([]) == ""


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "study.json, got none"), ("{", "expected JSON"), ('{"format": "other"}', "expected format"),
     ('{"format": "speckle3d.study", "version": 9}', "expected version 1, got 9")],
)  # fmt: skip
def test_what_is_no_study_is_refused(tmp_path, content, message):
    if content is not None:
        (tmp_path / "study.json").write_text(content)
    with pytest.raises(InvalidInputError, match=message):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_figures_of_what_is_no_longer_in_the_study_go_and_others_stay(tmp_path):
    entry = {"name": "a", "path": "a.h5", "status": "done", "folder": "sweeps/a-0123abcd"}
    study = {"format": "speckle3d.study", "version": 1, "modes": [], "sweeps": [entry]}
    (tmp_path / "study.json").write_text(json.dumps(study))
    (tmp_path / "figures").mkdir()
    stay = {"a-0123abcd-curves.png", "my-figure.png", "b-curves.png", "a-76543210-curves.txt"}
    for name in (*stay, "a-76543210-curves.png", "b-0123abcd-reslices.svg", "overview.png"):
        (tmp_path / "figures" / name).touch()
    write_report(tmp_path)
    assert {path.name for path in (tmp_path / "figures").iterdir()} == stay


def test_a_study_of_broken_sweeps_alone_is_still_a_page(tmp_path):
    study = {
        "format": "speckle3d.study",
        "version": 1,
        "modes": ["image"],
        "sweeps": [
            {"name": "torn", "path": "t.h5", "status": "failed", "reason": "no speckle"},
            {"name": "lost", "path": "l.h5", "status": "done", "folder": "sweeps/lost-1"},
        ],
    }
    (tmp_path / "study.json").write_text(json.dumps(study))
    words = " ".join(Page(write_report(tmp_path).read_text(encoding="utf-8")).words)
    assert "no speckle" in words
    assert "results cannot be shown" in words


def test_rejected_patches_count_only_those_with_a_distance():
    distance = np.array([[1.0, 1.0, np.nan], [1.0, 1.0, np.nan], [1.0, np.nan, np.nan], [1.0, 1.0, np.nan]])
    used = np.array([[1, 0, 0], [1, 0, 0], [0, 0, 0], [1, 1, 0]], dtype=bool)
    first = np.array([0, 0, 2, 3])
    pairs = FramePairs(first, first + 1, np.tile(np.eye(4), (4, 1, 1)), np.zeros((4, 6, 6)),
                       distance, distance, used, np.array([[1.0, 2], [3, 2], [5, 2]]))  # fmt: skip
    found = rejected_patches(pairs, 5)
    np.testing.assert_allclose(found.share, [1 / 4, 2 / 3, np.nan])
    np.testing.assert_allclose(found.frame_share, [2 / 4, np.nan, 1, 0, np.nan])
    heat = plot_rejected(found)["data"][0]
    assert heat["z"] == [[25.0, 66.667, None]]
    assert (heat["x"], heat["y"]) == ([1.0, 3.0, 5.0], [2.0])
    assert patch_size(found.centre_mm) == (2.0, 3.0)


def test_differences_from_the_reference_are_a_button_away():
    ramp = np.tile(np.linspace(0, 10, 50), (4, 1))
    plot = plot_curves(SweepCurves({"image": 1.1 * ramp}, ramp, "tracker", 0.5 * np.ones((4, 50))))
    absolute, minus = plot["layout"]["updatemenus"][0]["buttons"]
    shown = [t for t, v in zip(plot["data"], minus["args"][0]["visible"], strict=True) if v]
    (image,) = [t for t in shown if t["name"] == "image-based" and t["xaxis"] == "x1"]
    np.testing.assert_allclose(image["y"], 0.1 * ramp[0], atol=6e-4)
    low, high = [t for t in shown if t["name"].startswith("95 %") and t["xaxis"] == "x1"]
    np.testing.assert_allclose(np.subtract(high["y"], low["y"]), 1.0, atol=2e-3)
    assert absolute["args"][0]["visible"] == [not v for v in minus["args"][0]["visible"]]
    assert "updatemenus" not in plot_curves(SweepCurves({"image": ramp}, None, "none", None))["layout"]


def test_long_curves_are_thinned_and_keep_their_ends():
    frames = decimated(5000)
    assert (frames.size, frames[0], frames[-1]) == (MOST_POINTS, 0, 4999)
    assert decimated(7).tolist() == list(range(7))


def test_outlines_are_closed_and_apart():
    poses = RigidTransform.from_translation([[0.0, 0, 0], [0, 0, 1], [0, 0, 2]])
    grid = ImageGrid(11, 21, 1.0, 1.0, 2.0)
    line = outline(poses, grid)
    assert line.shape == (18, 3)
    assert np.isnan(line[5::6]).all()
    np.testing.assert_array_equal(line[0], line[4])
    np.testing.assert_array_equal(line[12:16, 2], 2.0)
    assert (line[2] == [10.0, 22.0, 0.0]).all()


def test_names_of_columns_become_words_with_units():
    assert heading_of("length_error_percent") == "length error / %"
    assert heading_of("GPE_mm") == "GPE / mm"
    assert "<b>" not in records_table([{"name": "<b>bold</b>", "share": [0.5, None]}])
    assert "0.500, –" in records_table([{"name": "x", "share": [0.5, None]}])
