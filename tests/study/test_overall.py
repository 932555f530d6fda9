import re

import numpy as np
import pytest

from speckle3d.scoring.statistics import mean_interval
from speckle3d.study.overall import (
    are_uneven,
    beats,
    fitted_to_reference,
    over_sweeps,
    overall_text,
    reference_words,
    shared_means,
)


def study(sweeps, gain=3.0, seed=3):
    """Rows of `sweeps` sweeps of two parts: `pose` is better than `image` by `gain` % in every one of them.

    `twin` is `image` with errors of the other sign and a little scatter.
    """
    rng = np.random.default_rng(seed)
    rows, drift = [], []
    for i in range(sweeps):
        base = 10.0 + rng.uniform(-4.0, 4.0)
        errors = {
            "image": base,
            "twin": base + rng.normal(0.0, 0.5),
            "pose": base - gain + rng.normal(0.0, 0.3),
        }
        for mode, error in errors.items():
            sign = -1.0 if mode == "twin" else 1.0
            for part, share in (("f", 0.5), ("r", -1.5)):
                rows.append(
                    {"sweep": f"s{i}", "part": part, "mode": mode, "length_error_mm": 0.1,
                     "length_error_percent": sign * share * error,
                     "tilt_error_deg": float("nan"), "yaw_error_deg": 0.0,
                     "roll_error_deg": 0.0}
                )  # fmt: skip
            drift.append(
                {"sweep": f"s{i}", "mode": mode, "FDR_percent": error, "GPE_mm": 0.1, "GLE_mm": None}
            )
    return rows, drift


def of(records, quantity, *modes):
    (found,) = [
        r
        for r in records
        if r["quantity"] == quantity and (r["mode"], r.get("against"))[: len(modes)] == modes
    ]
    return found


def test_one_number_per_sweep_is_the_mean_magnitude_of_its_parts():
    rows, drift = study(11)
    intervals, _ = over_sweeps(rows, drift)
    found = of(intervals, "length_error_percent", "image")
    by_sweep = [
        np.mean(
            [abs(r["length_error_percent"]) for r in rows if r["sweep"] == f"s{i}" and r["mode"] == "image"]
        )
        for i in range(11)
    ]
    expected = mean_interval(by_sweep)
    assert (found["sweeps"], found["mean"], found["low"], found["high"]) == (
        11, pytest.approx(expected.mean), expected.low, expected.high,
    )  # fmt: skip
    assert expected.low < expected.mean < expected.high
    assert of(intervals, "FDR_percent", "image")["mean"] == pytest.approx(expected.mean)
    # Quantities without a value are left out, those without scatter have no interval.
    assert {r["quantity"] for r in intervals} & {"tilt_error_deg", "GLE_mm", "MD_mm"} == set()
    assert of(intervals, "GPE_mm", "pose")["low"] is None


def test_modes_that_differ_in_every_sweep_are_beats_and_like_ones_not():
    _, paired = over_sweeps(*study(11))
    found = of(paired, "length_error_percent", "image", "pose")
    assert (found["better"], found["sweeps"]) == ("pose", 11)
    assert 2.5 < found["low"] < found["difference"] < found["high"] < 3.5
    # All eleven signs alike: 2 of 2**11 assignments; the smallest of three p values counts three times.
    assert found["wilcoxon_p"] == pytest.approx(2 / 2**11)
    assert found["holm_p"] >= 2 * found["wilcoxon_p"]
    assert of(paired, "length_error_percent", "image", "twin")["better"] is None
    assert beats(paired, "FDR_percent", "pose", "image")
    assert not beats(paired, "FDR_percent", "image", "pose")
    assert not beats(paired, "FDR_percent", "twin", "image")


def test_few_sweeps_tell_nothing_apart_though_all_agree():
    for sweeps in (1, 2, 4, 5):
        _, paired = over_sweeps(*study(sweeps))
        assert {row["better"] for row in paired} == {None}


def test_the_text_is_compact_and_says_who_is_better():
    intervals, paired = over_sweeps(*study(11))
    lines = overall_text(intervals, paired).splitlines()
    assert lines[0].split() == ["mean", "of", "11", "sweeps", "image", "twin", "pose"]
    (fdr,) = [line for line in lines if line.startswith("FDR %")]
    found = of(intervals, "FDR_percent", "pose")
    assert f"{found['mean']:.1f} [{found['low']:.1f}, {found['high']:.1f}]" in fdr
    (apart,) = [line for line in lines if line.startswith("less ")]
    assert apart == "less length error %, FDR %: pose than image, twin"
    assert max(len(line) for line in lines) <= 110
    assert overall_text([], []) == ""


def test_a_mode_that_only_some_sweeps_have_is_compared_on_those():
    rows, drift = study(8)
    rows, drift = (
        [row for row in some if not (row["mode"] == "pose" and row["sweep"] in ("s0", "s1"))]
        for some in (rows, drift)
    )
    intervals, paired = over_sweeps(rows, drift)
    assert of(intervals, "length_error_percent", "pose")["sweeps"] == 6
    assert of(paired, "length_error_percent", "image", "pose")["sweeps"] == 6
    # The text says which means are of fewer sweeps, and has those of the same sweeps beside them.
    shared = shared_means(rows, drift)
    text = overall_text(intervals, paired, shared)
    assert text.startswith("mean of 8 sweeps")
    (line,) = [each for each in text.splitlines()[:4] if each.startswith("length error %")]
    assert line.endswith("(6)")
    assert line.count("(") == 1
    assert "6 sweeps with every mode" in text
    alike = over_sweeps([row for row in rows if row["sweep"] not in ("s0", "s1")], [])[0]
    for mode in ("image", "twin", "pose"):
        expected = of(alike, "length_error_percent", mode)["mean"]
        found = of(shared, "length_error_percent", mode)
        assert (found["mean"], found["sweeps"]) == (pytest.approx(expected), 6)


def test_modes_that_no_sweep_has_together_are_not_ranked():
    rows, _ = study(4)
    rows = [row for row in rows if (row["mode"] == "pose") == (row["sweep"] == "s0")]
    assert shared_means(rows) == []
    assert are_uneven(over_sweeps(rows, [])[0])


def test_the_text_says_what_the_reference_was():
    found = over_sweeps(*study(2))
    same, mixed = ({"s0": "truth", "s1": name} for name in ("truth", "tracker"))
    for references in (same, mixed):
        assert reference_words(references) in overall_text(*found, (), references)
    assert re.search("truth of s0.*tracker of s1", reference_words(mixed))
    assert fitted_to_reference(["image", "pose"], mixed)
    assert not fitted_to_reference(["image", "pose"], same)
    assert not fitted_to_reference(["image"], mixed)
