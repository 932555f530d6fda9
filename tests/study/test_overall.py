"""Means over sweeps, and which modes the sweeps tell apart."""

import numpy as np
import pytest

from speckle3d.study.overall import over_sweeps


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
            "twin": -(base + rng.normal(0.0, 0.5)),
            "pose": base - gain + rng.normal(0.0, 0.3),
        }
        for mode, error in errors.items():
            at = {"sweep": f"s{i}", "mode": mode}
            for part, share in (("f", 0.5), ("r", -1.5)):
                rows.append(
                    {**at, "part": part, "length_error_percent": share * error, "tilt_error_deg": None}
                )
            drift.append({**at, "FDR_percent": abs(error), "GPE_mm": 0.1, "GLE_mm": None})
    return rows, drift


def of(records, quantity, *modes):
    (record,) = [
        r
        for r in records
        if r["quantity"] == quantity and (r["mode"], r.get("against"))[: len(modes)] == modes
    ]
    return record


def test_modes_that_differ_in_every_sweep_are_told_apart_and_like_ones_not():
    _, comparisons = over_sweeps(*study(11))
    pair = of(comparisons, "length_error_percent", "image", "pose")
    assert (pair["better"], pair["sweeps"]) == ("pose", 11)
    assert 2.5 < pair["low"] < pair["difference"] < pair["high"] < 3.5
    # All eleven signs alike: 2 of 2**11 assignments; the smallest of three p values counts three times.
    assert pair["wilcoxon_p"] == pytest.approx(2 / 2**11)
    assert pair["holm_p"] >= 2 * pair["wilcoxon_p"]
    assert of(comparisons, "length_error_percent", "image", "twin")["better"] is None
