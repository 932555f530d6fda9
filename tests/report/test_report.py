"""The page and its parts: the study's facts, names escaped, pictures and plots of the same series."""

import base64
import html
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from report_examples import HOSTILE, MODES, REASON
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.printable import printable
from speckle3d.core.reconstruction import FramePairs
from speckle3d.core.sweep import ImageGrid
from speckle3d.report.data import cut_modes, load_view, read_study, rejected_patches
from speckle3d.report.figures import (
    MOST_POINTS,
    decimated,
    figure_outlines,
    outline_series,
    overview_panels,
    patch_size,
    plot_outlines,
    plot_panels,
    plot_rejected,
)
from speckle3d.report.page import write_report
from speckle3d.report.tables import (
    Scored,
    heading_of,
    intervals_table,
    paired_table,
    parts_table,
    records_table,
    scored_means,
    summary_lines,
)
from speckle3d.scoring.references import SweepCurves
from speckle3d.study.figures import curve_panels, label_of
from speckle3d.study.overall import over_sweeps


@pytest.fixture(scope="module")
def text(report_study):
    return (report_study / "report.html").read_text(encoding="utf-8")


def test_what_is_in_doubt_stands_at_the_top(text):
    place = text.index('id="doubts"')
    assert place < text.index('id="modes"')
    row = text[place : text.index("</table>", place)]
    assert "units &lt;in&gt; metres" in row
    assert "expected 3 mm, got 0.003" in row
    assert "refused" in row


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


def write_study(folder, sweeps, **more):
    study = {"format": "speckle3d.study", "version": 1, "modes": ["image"], "sweeps": sweeps, **more}
    (folder / "study.json").write_text(json.dumps(study))


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
    # The library is 5 MB; 0.6 MB for each sweep keep a study of eleven under 12 MB. These two are small.
    assert len(text.encode()) < 5.0e6 + 2 * 0.4e6


def test_the_summary_comes_first_and_says_what_the_rows_say(page, report_study):
    rows = read_study(report_study).rows
    assert {r["part"] for r in rows} == {"f"}
    mean = {m: np.mean([abs(r["length_error_percent"]) for r in rows if r["mode"] == m]) for m in MODES}
    best = min(mean, key=mean.get)
    words = " ".join(page.words)
    lead = words[: words.index("Errors by sweep and part")]
    found = scored_means(rows, MODES)
    for line in summary_lines(found, 2, 1, read_study(report_study).paired):
        assert line in lead
    first, *_ = summary_lines(found, 2, 1)
    assert first.index(label_of(best)) < first.index(f"{mean[best]:.1f} %")
    assert {row["mode"]: row["length_percent"] for row in found.means} == pytest.approx(mean)


def test_every_row_is_in_the_table_and_the_broken_sweep_with_its_reason(page, report_study):
    words = " ".join(page.words)
    for row in read_study(report_study).rows:
        assert f"{row['length_error_mm']:+.2f}" in words
        assert f"{row['tilt_error_deg']:+.2f}" in words
    assert printable(REASON) in words
    assert "GPE / mm" in words
    assert "12.3" in words
    assert "sensors" in words[words.index("Every setting") :]


def test_names_and_reasons_of_others_are_text(text, page):
    assert HOSTILE not in text
    assert "&lt;three&gt; axes &amp; more" in text
    # What drives a terminal or turns the direction of writing is shown; the scripts of plotly have their own.
    assert r"got \x1b[31mnone\u202e" in text
    assert not {"\x1b", "\u202e"} & set(text.partition("<script>")[0])
    # Plotly takes some markup in what it shows under the pointer.
    plot = re.search(r'id="plot-overview">(.*?)</script>', text)[1]
    shown = {word for trace in json.loads(plot)["data"] for word in trace.get("text", ())}
    assert f"{html.escape(HOSTILE, quote=False)}, part f" in shown
    # In the chooser, above its figures, in its rows of the table and in the provenance.
    assert page.words.count(HOSTILE) >= 2 + len(MODES)
    # The two of the page, and the data of the plots.
    scripts = [a.get("type") for tag, a in page.tags if tag == "script"]
    assert scripts == ["application/json"] * 7 + [None, None]


def test_a_sweep_whose_file_is_gone_is_shown_without_reference_and_reslices(page, report_study):
    words = " ".join(page.words)
    assert str(report_study / "gone.h5") in words
    figures = {path.name for path in (report_study / "figures").iterdir()}
    for kind in ("png", "svg"):
        assert {f"forward-0a-{f}.{kind}" for f in ("curves", "outlines", "reslices", "patches")} <= figures
        assert f"gone-0b-curves.{kind}" in figures
        assert f"gone-0b-reslices.{kind}" not in figures


def test_the_interactive_plots_hold_the_curves(text, report_study):
    found = re.search(r'id="plot-forward-0a-curves">(.*?)</script>', text)
    traces = json.loads(found[1])["data"]
    view = load_view(report_study, read_study(report_study).done[0])
    name = label_of("pose")
    (pose,) = [t for t in traces if t["name"] == name and t["visible"] and t["xaxis"] == "x"]
    values = np.frombuffer(base64.b64decode(pose["y"]["bdata"]), np.dtype(pose["y"]["dtype"]))
    np.testing.assert_allclose(values, view.curves.modes["pose"][0], rtol=1e-6)


def test_pictures_of_the_page_are_pictures(text):
    kinds = {"svg+xml": b"<?xml", "png": b"\x89PNG", "jpeg": b"\xff\xd8"}
    found = re.findall(r'<img[^>]* src="data:image/([^;]+);base64,([^"]+)"', text)
    # The overview, four of the sweep that is there, three of the one that is gone.
    assert len(found) == 8
    assert all(base64.b64decode(data).startswith(kinds[kind]) for kind, data in found)


def test_the_same_detail_is_cut_in_every_mode(report_study):
    view = load_view(report_study, read_study(report_study).done[0])
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


def test_a_changed_sweep_is_not_taken_for_the_one_reconstructed(report_study, tmp_path):
    entry = read_study(report_study).done[0]
    other = tmp_path / "forward.h5"
    other.write_bytes(b"another")
    view = load_view(report_study, entry | {"path": str(other)})
    assert view.sweep is None
    assert str(other) in view.notes[0]


def named_in(line):
    """Modes that a sentence names, in the order of their first mention."""
    labels = {mode: line.find(label_of(mode)) for mode in MODES}
    return sorted((mode for mode, at in labels.items() if at >= 0), key=labels.get)


def test_without_a_reference_or_any_result_no_mode_is_called_right():
    assert [named_in(line) for line in summary_lines(Scored([]), 2, 0)] == [[]]
    (line,) = summary_lines(Scored([]), 0, 2)
    assert "2 sweeps" in line


def test_the_best_in_length_and_the_best_in_tilt_may_differ():
    length, tilt = summary_lines(scored(image=4.0, pose=2.0), 2, 0)
    assert named_in(length) == ["pose", "image"]
    assert re.search(r"2 sweeps.*2 parts.*2\.0 %.*4\.0 %", length)
    assert named_in(tilt)[0] == "image"


def test_the_lead_means_over_sweeps_of_their_parts_as_the_tables_do():
    rows = part_rows(a_image=[1.0, -3.0], b_image=[8.0])
    found = scored_means(rows, ["image"])
    # Pooled parts would give 4.
    assert found.means[0]["length_percent"] == pytest.approx(5.0)
    assert (found.means[0]["sweeps"], found.parts) == (2, 3)
    intervals, _ = over_sweeps(rows, [])
    assert intervals[0]["mean"] == pytest.approx(5.0)
    assert re.search("2 sweeps.*3 parts", summary_lines(found, 2, 0)[0])


def test_modes_of_different_sweeps_are_ranked_on_those_that_have_all():
    # On the hard sweep only images could be had; there they are wrong by 40 %.
    rows = part_rows(a_image=[2.0], a_pose=[3.0], hard_image=[40.0])
    found = scored_means(rows, ["image", "pose"])
    assert [row["length_percent"] for row in found.means] == [2.0, 3.0]
    line = summary_lines(found, 2, 0)[0]
    assert re.search("1 sweep .*1 part", line)
    assert named_in(line)[0] == "image"
    assert found.left_out == 1
    apart = scored_means(part_rows(a_image=[2.0], b_pose=[3.0]), ["image", "pose"])
    assert not apart.together
    assert named_in(summary_lines(apart, 2, 0)[0]) == []


def test_the_lead_says_what_the_reference_was_and_what_was_fitted_to_it():
    three = scored(image=4.0, pose=2.0)
    plain = summary_lines(three, 2, 0)
    mixed, same = (
        [line for line in summary_lines(three, 2, 0, [], names) if line not in plain]
        for names in ({"a": "truth", "b": "tracker"}, {"a": "truth", "b": "truth"})
    )
    assert re.search("truth of a.*tracker of b", mixed[0])
    assert label_of("pose")[1:] in mixed[1]
    assert len(same) == 1
    assert "truth" in same[0]


def test_the_lead_leaves_copies_out(tmp_path):
    rows = [row | {"reference": "truth"} for row in part_rows(a_image=[1.0], b_image=[1.0])]
    done = {"status": "done", "path": "x.h5", "folder": "sweeps/none"}
    sweeps = [{"name": "a", **done}, {"name": "b", "copy_of": "a", **done}]
    write_study(tmp_path, sweeps, rows=rows)
    found = read_study(tmp_path)
    assert found.copies == {"b": "a"}
    assert [row["sweep"] for row in found.single] == ["a"]
    assert found.references == {"a": "truth"}
    words = " ".join(Page(write_report(tmp_path).read_text(encoding="utf-8")).words)
    assert "1 sweep " in words[: words.index("b is a copy of a")]


def pairs(quantity, *told):
    """Three modes compared in a quantity; `told` are the pairs that are told apart."""
    modes = ("image", "orientation", "pose")
    return [
        {"quantity": quantity, "mode": a, "against": b, "better": b if (a, b) in told else None,
         "difference": 1.0, "low": -0.5, "high": 2.5}
        for i, a in enumerate(modes) for b in modes[i + 1 :]
    ]  # fmt: skip


def test_the_lead_names_the_modes_that_are_not_told_apart_from_the_best():
    three, first = scored(image=4.0, orientation=3.0, pose=2.0), ("image", "pose")
    quantity = "length_error_percent"
    bare = summary_lines(three, 2, 0)[0].split(" It ")[0]

    def doubt(*told):
        return summary_lines(three, 2, 0, pairs(quantity, *told))[0].removeprefix(bare)

    every, none, some = doubt(first, ("orientation", "pose")), doubt(), doubt(first)
    assert len({every, none, some}) == 3
    assert named_in(some) == ["orientation"]
    assert named_in(every) == named_in(none) == []
    two, _ = summary_lines(scored(image=4.0, pose=2.0), 2, 0, [])
    assert two.count(label_of("image")) == 2


def test_means_and_differences_over_sweeps_are_tables(page):
    words = " ".join(page.words)
    assert "1.0 [0.5, 1.5]" in words
    assert "+11.1 [+2.1, +20.0]" in words
    assert f"{label_of('image')} − {label_of('pose')}" in words
    ((_, line),) = paired_table(pairs("FDR_percent", ("image", "pose"))).lines
    assert [cell.is_bold for cell in line] == [False, False, True, False]
    assert line[1].text.splitlines() == ["+1.0", "[−0.5, +2.5]"]
    assert intervals_table([]) is None
    # Means of fewer sweeps say so.
    held = {"quantity": "FDR_percent", "low": None, "high": None, "mean": 0.5}
    rows = [held | {"mode": mode, "sweeps": sweeps} for mode, sweeps in (("image", 4), ("pose", 1))]
    ((_, line),) = intervals_table(rows).lines
    assert [cell.text for cell in line] == ["FDR %", "0.5", "0.5 (1)"]


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "study.json"), ("{", "study.json.*JSON"), ('{"format": "other"}', "study.json.*format"),
     ('{"format": "speckle3d.study", "version": 9}', "version.*1.*9")],
)  # fmt: skip
def test_what_is_no_study_is_refused(tmp_path, content, message):
    if content is not None:
        (tmp_path / "study.json").write_text(content)
    with pytest.raises(InvalidInputError, match=message):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_figures_of_what_is_no_longer_in_the_study_go_and_others_stay(tmp_path):
    entry = {"name": "a", "path": "a.h5", "status": "done", "folder": "sweeps/a-0123abcd"}
    write_study(tmp_path, [entry])
    (tmp_path / "figures").mkdir()
    stay = {"a-0123abcd-curves.png", "my-figure.png", "b-curves.png", "a-76543210-curves.txt"}
    for name in (*stay, "a-76543210-curves.png", "b-0123abcd-reslices.svg", "overview.png"):
        (tmp_path / "figures" / name).touch()
    write_report(tmp_path)
    assert {path.name for path in (tmp_path / "figures").iterdir()} == stay


def test_a_study_of_broken_sweeps_alone_is_still_a_page(tmp_path):
    torn = {"name": "torn", "path": "t.h5", "status": "failed", "reason": "no speckle"}
    lost = {"name": "lost", "path": "l.h5", "status": "done", "folder": "sweeps/lost-1"}
    write_study(tmp_path, [torn, lost])
    words = " ".join(Page(write_report(tmp_path).read_text(encoding="utf-8")).words)
    assert "no speckle" in words
    # The sweep whose folder is gone is told with it.
    assert str(tmp_path / "sweeps" / "lost-1") in words


def test_rejected_patches_count_only_those_with_a_distance():
    distance = np.array([[1.0, 1.0, np.nan], [1.0, 1.0, np.nan], [1.0, np.nan, np.nan], [1.0, 1.0, np.nan]])
    used = np.array([[1, 0, 0], [1, 0, 0], [0, 0, 0], [1, 1, 0]], dtype=bool)
    first = np.array([0, 0, 2, 3])
    pairs = FramePairs(first, first + 1, np.tile(np.eye(4), (4, 1, 1)), np.zeros((4, 6, 6)),
                       distance, distance, used, np.array([[1.0, 2], [3, 2], [5, 2]]))  # fmt: skip
    found = rejected_patches(pairs, 5)
    np.testing.assert_allclose(found.share, [1 / 4, 2 / 3, np.nan])
    np.testing.assert_allclose(found.frame_share, [2 / 4, np.nan, 1, 0, np.nan])
    heat = plot_rejected(found).data[0]
    np.testing.assert_allclose(heat.z, [[25.0, 200 / 3, np.nan]], rtol=1e-6)
    assert (list(heat.x), list(heat.y)) == ([1.0, 3.0, 5.0], [2.0])
    assert patch_size(found.centre_mm) == (2.0, 3.0)


def test_differences_from_the_reference_are_a_button_away():
    ramp = np.tile(np.linspace(0, 10, 50), (4, 1))
    curves = SweepCurves({"image": 1.1 * ramp}, ramp, "tracker", 0.5 * np.ones((4, 50)))
    views = {"accumulated": curve_panels(curves), "minus": curve_panels(curves, minus_reference=True)}
    plot = plot_panels(views, 2, 600)
    absolute, minus = (button.args[0]["visible"] for button in plot.layout.updatemenus[0].buttons)
    assert list(absolute) == [not shown for shown in minus] == [trace.visible for trace in plot.data]
    shown = [t for t, visible in zip(plot.data, minus, strict=True) if visible and t.xaxis == "x"]
    (image,) = [t for t in shown if t.name == label_of("image")]
    np.testing.assert_allclose(image.y, 0.1 * ramp[0], atol=1e-6)
    low, high = [t for t in shown if t.line.width == 0]
    np.testing.assert_allclose(np.subtract(high.y, low.y), 1.0, atol=1e-6)
    assert not plot_panels({"": curve_panels(SweepCurves({"image": ramp}))}, 2, 600).layout.updatemenus


def test_the_overview_has_a_point_for_every_part_and_a_bar_at_the_mean():
    rows = part_rows(a_image=[1.0, -3.0], b_image=[8.0], a_pose=[2.0])
    length, _ = panels = overview_panels(rows, ["image", "pose"])
    bar, points, _, pose = length.series
    np.testing.assert_array_equal(bar.points, [[-5.0, 0.0], [5.0, 0.0]])
    assert points.points[:, 0].tolist() == [1.0, -3.0, 8.0]
    assert points.words == ["a, part f", "a, part r", "b, part f"]
    # Beside its mode's name, one below the other.
    assert np.abs(points.points[:, 1]).max() < 0.5
    assert pose.points[:, 1].round().tolist() == [1.0]
    plot = plot_panels({"": panels}, 2, 200)
    assert next(list(t.text) for t in plot.data if t.text is not None) == points.words
    assert list(plot.layout.yaxis.ticktext) == [label_of("image"), label_of("pose")]


def test_long_curves_are_thinned_and_keep_their_ends():
    frames = decimated(5000)
    assert (frames.size, frames[0], frames[-1]) == (MOST_POINTS, 0, 4999)
    assert decimated(7).tolist() == list(range(7))


def test_outlines_are_closed_and_apart():
    poses = RigidTransform.from_translation([[0.0, 0, 0], [0, 0, 1], [0, 0, 2]])
    reference, image = outline_series({"image": poses, "truth": poses}, ImageGrid(11, 21, 1.0, 1.0, 2.0))
    assert (reference.style, image.style) == ("reference", "line")
    line = image.points
    assert line.shape == (18, 3)
    assert np.isnan(line[5::6]).all()
    np.testing.assert_array_equal(line[0], line[4])
    np.testing.assert_array_equal(line[12:16, 2], 2.0)
    assert (line[2] == [10.0, 22.0, 0.0]).all()
    # In space the elevational axis comes first and depth points down.
    np.testing.assert_array_equal(plot_outlines([image]).data[0].x, line[:, 2])
    assert len(figure_outlines([reference, image]).axes) == 1


def test_names_of_columns_become_words_with_units():
    assert heading_of("length_error_percent") == "length error / %"
    assert heading_of("GPE_mm") == "GPE / mm"
    ((_, line),) = records_table([{"name": "x", "share": 0.5, "LPE_mm": 0.01234, "GLE_mm": None}]).lines
    assert [cell.text for cell in line] == ["x", "0.500", "0.0123", "–"]
    assert [cell.is_word for cell in line] == [True, False, False, False]
    assert records_table([]) is None


def test_rows_of_a_sweep_lead_to_its_figures():
    rows = part_rows(a_image=[1.0, 2.0], b_image=[3.0])
    lines = parts_table(rows, {"a": "sweep-1"}).lines
    assert [style for style, _ in lines] == ["first", "first", "first"]
    assert [cells[0].link for _, cells in lines] == ["sweep-1", "sweep-1", ""]
