"""The table of pair correlations."""

import numpy as np

from speckle3d.matching.inplane import InPlaneMotion, MatchedPair
from speckle3d.matching.table import CorrelationTable


def pair(*correlation, x_mm=0.0, y_mm=0.0):
    rho, known = np.array(correlation), [value for value in correlation if np.isfinite(value)]
    median = float(np.median(known)) if known else 0.0
    return MatchedPair(rho, median, InPlaneMotion(x_mm, y_mm))


def table(*rows):
    return CorrelationTable.of(rows, 3)


def test_a_pairs_median_is_over_the_patches_that_have_a_correlation():
    assert pair(0.2, np.nan, 0.6).median == 0.4
    assert pair(np.nan, np.nan, np.nan).median == 0.0


def test_a_frame_is_unmatched_when_its_best_pair_is_below_the_least_correlation():
    pairs = table(
        (0, 1, pair(0.9, 0.9, 0.9)),
        (0, 2, pair(0.1, 0.1, 0.1)),
        (1, 2, pair(0.19, 0.19, 0.19)),
        (1, 3, pair(0.1, 0.1, 0.1)),
        (2, 3, pair(0.2, 0.2, 0.2)),
    )
    # Frame 4 was matched with nothing; the first frame has no earlier one.
    assert pairs.unmatched(5, 0.2).tolist() == [False, False, True, False, True]


def test_no_pairs_are_an_empty_table():
    empty = table()
    assert len(empty) == 0
    assert empty.correlation.shape == (0, 3)
