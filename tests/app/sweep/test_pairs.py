"""Patches of frame pairs, as kept in a reconstruction or correlated anew."""

import numpy as np
import pytest

from speckle3d.app.sweep.pairs import SweepPairs
from speckle3d.config import Config
from speckle3d.matching.frames import match_sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.schedule import PairSchedule


@pytest.fixture(scope="module")
def part(sweep):
    return sweep.part(0, 12)


@pytest.fixture(scope="module")
def table(part):
    c = Config()
    matcher = FrameMatcher(part, c)
    return match_sweep(part, matcher, PairSchedule(c.trajectory)).table


def test_correlations_computed_anew_are_those_that_the_pipeline_reads(part, table):
    row = int(np.flatnonzero((table.first == 4) & (table.second == 5))[0])
    values = SweepPairs(part, Config()).values(5, 4, with_correlation=True)
    # In-plane motion is looked for anew, from another start.
    np.testing.assert_allclose(values.correlation, table.correlation[row], atol=2e-3)
    assert values.inliers is None
