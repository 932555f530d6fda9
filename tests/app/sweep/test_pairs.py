"""Patches of frame pairs, as kept in a reconstruction or correlated anew."""

import numpy as np
import pytest

from speckle3d.app.sweep.pairs import SweepPairs
from speckle3d.config import Config
from speckle3d.core.reconstruction import FramePairs
from speckle3d.matching.frames import match_sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.schedule import PairSchedule


@pytest.fixture(scope="module")
def part(sweep):
    return sweep.part(0, 12)


@pytest.fixture(scope="module")
def matched(part):
    c = Config()
    matcher = FrameMatcher(part, c.intensity, c.patches, c.inplane, c.matching)
    return matcher, match_sweep(part, matcher, PairSchedule(c.trajectory), c.quality).table


@pytest.fixture(scope="module")
def kept(matched):
    """Some of the pairs as a reconstruction would keep them, displaced by 0.5 mm and turned by 0.02 rad."""
    matcher, _ = matched
    first, second, patches = np.array([2, 4, 3]), np.array([3, 5, 5]), len(matcher.patches)
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]]
    centre = matcher.centre_mm
    pose[:3, 3] = centre - pose[:3, :3] @ centre + [0.5, 0.0, -0.3]
    distance = np.tile(np.linspace(0.1, 0.4, patches, dtype=np.float32), (3, 1))
    distance[:, 7] = np.nan
    used = np.ones((3, patches), dtype=bool)
    used[:, [3, 7]] = False
    return FramePairs(
        first, second, np.tile(pose, (3, 1, 1)), np.tile(0.04**2 * np.eye(6), (3, 1, 1)), distance,
        distance / 10, used, matcher.patches.centre_mm,
    )  # fmt: skip


def test_correlations_computed_anew_are_those_that_the_pipeline_reads(part, matched):
    _, table = matched
    row = int(np.flatnonzero((table.first == 4) & (table.second == 5))[0])
    values = SweepPairs(part, Config()).values(5, 4, with_correlation=True)
    # In-plane motion is looked for anew, from another start.
    np.testing.assert_allclose(values.correlation, table.correlation[row], atol=2e-3)
    assert values.used is None


def test_what_a_reconstruction_keeps_of_a_pair_is_shown_as_it_is_kept(part, kept):
    pairs = SweepPairs(part, Config(), kept)
    values = pairs.values(3, 2, with_correlation=False)
    np.testing.assert_array_equal(values.distance_mm, kept.distance_mm[0])
    np.testing.assert_array_equal(values.sigma_mm, kept.sigma_mm[0])
    np.testing.assert_array_equal(values.used, kept.used[0])
    assert values.moved_mm == pytest.approx((0.3, 0.04))
    unpaired = pairs.values(8, 7, with_correlation=False)
    assert unpaired.used is None
    assert np.nanmedian(unpaired.correlation) > 0.5
