"""A tracker's jitter is told from its own readings, and what it makes of a length."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.scoring.jitter import jitter_mm, jitter_percent
from speckle3d.scoring.lengths import ModeError
from speckle3d.study.results import Summary, rows_of

CENTRE = np.array([7.0, 20.0, 0.0])


def swept(frames, length_mm, sigma_mm, seed):
    """A hand that goes smoothly along z, seen by a tracker with white noise."""
    t = np.linspace(0.0, 1.0, frames)
    along = length_mm * (t * t * (3 - 2 * t)) + 0.3 * np.sin(9 * t)
    place = np.outer(along, [0.0, 0.0, 1.0])
    return RigidTransform.from_translation(
        place + np.random.default_rng(seed).normal(0, sigma_mm, (frames, 3))
    )


@pytest.mark.parametrize("sigma_mm", [0.05, 0.15, 0.5])
def test_the_jitter_is_found(sigma_mm):
    found = [jitter_mm(swept(150, 15.0, sigma_mm, seed), CENTRE) for seed in range(20)]
    # A robust deviation of 147 correlated differences is known to some 15 %; the mean of 20 to 4 %.
    assert np.mean(found) == pytest.approx(sigma_mm, rel=0.12)


def test_a_smooth_path_has_none():
    assert jitter_mm(swept(150, 15.0, 0.0, 0), CENTRE) < 0.002
    assert np.isnan(jitter_mm(swept(5, 1.0, 0.1, 0), CENTRE))


def test_its_share_of_a_length_is_what_a_fitted_cubic_leaves():
    frames, length, sigma = 48, 5.0, 0.15
    t = np.linspace(-1, 1, frames)
    ends = [
        np.ptp(np.polyval(np.polyfit(t, np.random.default_rng(s).normal(0, sigma, frames), 3), [-1, 1]))
        for s in range(400)
    ]
    wanted = 100 * np.sqrt(np.mean(np.square(ends))) / length
    claimed = np.mean([jitter_percent(swept(frames, length, sigma, seed), CENTRE) for seed in range(40)])
    assert claimed == pytest.approx(wanted, rel=0.2)


def test_it_stands_beside_lengths_that_rest_on_the_tracker_and_only_there():
    rows = [ModeError("f", mode, 40, 5.0, 5.1, 0.1, 2.0, 0.0, 0.0, 0.0) for mode in ("image", "pose")]
    for reference, expected in (("truth", [False, True]), ("tracker", [True, True])):
        told = rows_of([Summary("s", reference, 40, 1.0, rows, jitter_percent=3.21)])
        assert ["tracker's jitter alone +- 3.2 %" in row["remark"] for row in told] == expected
    quiet = rows_of([Summary("s", "tracker", 40, 1.0, rows, jitter_percent=0.4)])
    assert not any("jitter" in row["remark"] for row in quiet)
