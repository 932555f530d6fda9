"""A sweep that comes back, tied to its way there."""

from dataclasses import replace

import numpy as np
import pytest

from speckle3d import pipeline
from speckle3d.config import Config
from speckle3d.matching.frames import match_chosen
from speckle3d.motion.estimate import Motion
from speckle3d.motion.revisits import (
    AWAY_MM,
    MOST_CANDIDATES,
    REACH_MM,
    _candidates,
    _place,
    find_returns,
    tie_returns,
)
from speckle3d.pipeline import track

TURN = 21
"""First frame of the way back."""


class Reordered:
    """Frames of a sweep in another order, their echoes noisy from some frame on."""

    def __init__(self, frames, order, noisy_from, noise):
        self._frames, self._order, self._noisy_from, self._noise = frames, order, noisy_from, noise
        self.shape, self.dtype = (len(order), *frames.shape[1:]), frames.dtype

    def __getitem__(self, index):
        frame = self._frames[int(self._order[index])]
        if self._noise == 0 or index < self._noisy_from:
            return frame
        noise = np.random.default_rng(index).normal(0, self._noise * frame.std(), frame.shape)
        return (frame + noise).astype(frame.dtype)


def there_and_back(sweep, noise=0.0):
    """Frames of the shipped sweep on the way there, and others between them on the way back."""
    order = np.concatenate([np.arange(28, 70, 2), np.arange(69, 27, -2)])
    return replace(
        sweep,
        frames=Reordered(sweep.frames, order, TURN, noise),
        frame_time_s=0.04 * np.arange(order.size),
        truth=sweep.truth[order],
        tracker=None,
        orientation=None,
    )


def positions(sweep):
    """True elevational position of each frame's centre."""
    return (sweep.truth[0].inv() * sweep.truth).apply(sweep.grid.centre_mm)[:, 2]


@pytest.fixture(scope="module")
def returning(sweep):
    return there_and_back(sweep)


def ties_of(sweep, curves, position):
    """Ties found on a path, and the table that holds their pairs."""
    s = Config()
    matcher = pipeline.matcher_for(sweep, curves, s)
    problem = pipeline.motion_problem(curves, matcher, len(sweep), s)
    path = np.column_stack([position, np.zeros((len(position), 2))])
    returns = find_returns(position, s.trajectory.revisit_mm)
    table = match_chosen(sweep, matcher, [pair for each in returns for pair in each.pairs()])
    return tie_returns(returns, Motion(problem, None, None, None, path), table), table


# ---- whole sweeps ------------------------------------------------------------------------------------------


def end_error(sweep, curves, **settings):
    tracked = track(sweep, curves, Config.model_validate(settings))
    return abs(tracked.image[-1].apply(sweep.grid.centre_mm)[2] - positions(sweep)[-1]), tracked


def test_coming_back_is_seen(sweep, curves):
    back = there_and_back(sweep)
    tied, found = end_error(back, curves)
    loose, alone = end_error(back, curves, trajectory={"revisit_mm": 0.0})
    assert found.pairs > alone.pairs
    # Six millimetres there and back, 1 % each way; frames that see the same speckle are right to 0.01 mm.
    assert tied < 0.03
    assert tied <= loose + 0.005
    # Errors of pairs on both ways add up without ties, and the claimed deviation says so.
    assert found.covariance[-1, 2, 2] < alone.covariance[-1, 2, 2]


def test_revisits_draw_together_ways_that_drifted_apart(sweep, curves):
    """Noise on the way back alone: read as a phantom's, its distances come out too long."""
    back, plain = there_and_back(sweep, noise=0.2), {"coherence": {"adapt": False}}
    loose, _ = end_error(back, curves, **plain, trajectory={"revisit_mm": 0.0})
    tied, _ = end_error(back, curves, **plain)
    # 0.09 mm against 0.01 with any draw of the noise: half is asked for.
    assert loose > 0.05
    assert tied < 0.5 * loose


def test_one_way_no_frame_is_matched_again(sweep, curves, monkeypatch):
    chosen = []
    plain = pipeline.match_chosen
    monkeypatch.setattr(
        pipeline, "match_chosen", lambda s, m, pairs, **_: chosen.extend(pairs) or plain(s, m, chosen)
    )
    frames = np.arange(48)
    # Six millimetres, twice what a return takes at least.
    assert positions(sweep)[47] > 1.5 * AWAY_MM
    half = replace(
        sweep, frames=Reordered(sweep.frames, frames, 0, 0), frame_time_s=sweep.frame_time_s[:48],
        truth=sweep.truth[:48],
    )  # fmt: skip
    track(half, curves)
    assert not chosen


# ---- finding -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drift_mm", [0.0, 0.1, 0.25, -0.25])
def test_pairs_of_two_visits_are_on_their_true_sides_though_the_path_drifted(returning, curves, drift_mm):
    """The way back is believed to end so far from where it does."""
    z = positions(returning)
    believed = z.copy()
    believed[TURN:] += drift_mm * np.linspace(0, 1, TURN)
    found, table = ties_of(returning, curves, believed)
    assert len(found)
    for pair in (found[[k]] for k in range(len(found))):
        assert pair.first < TURN <= pair.second
        assert (table.first[pair.row], table.second[pair.row]) == (pair.first, pair.second)
        assert pair.sign == np.sign(z[pair.second] - z[pair.first])
        assert table.median[pair.row] > Config().trajectory.least_correlation
    # A millimetre of travel lies between frames that are tied.
    travel = np.concatenate([[0], np.cumsum(np.abs(np.diff(believed)))])
    assert (np.diff(travel[np.unique(found.second)]) >= 1.0).all()


def test_nothing_is_tied_where_the_path_is_beyond_reach(returning, curves):
    believed = positions(returning).copy()
    believed[TURN:] += 2.0
    assert len(ties_of(returning, curves, believed)[0]) == 0


def test_nothing_is_looked_for_where_it_is_not_wanted(returning):
    assert find_returns(positions(returning), 1.0)
    assert find_returns(positions(returning), 0.0) == []


def test_candidates_are_of_an_earlier_visit_few_and_nearest_first():
    there = np.arange(0, 12, 0.02)
    position = np.concatenate([there, there[::-1], there])
    travel = np.concatenate([[0], np.cumsum(np.abs(np.diff(position)))])
    for second in (700, 1000, 1700):
        found = _candidates(second, position, travel)
        off = np.abs(position[found] - position[second])
        assert 4 <= len(found) <= MOST_CANDIDATES
        assert (np.diff(off) >= 0).all()
        assert (travel[second] - travel[found] > AWAY_MM).all()
    # The latest visit before has a say, be it with or without those before it.
    assert 1 in {i // there.size for i in found}
    assert _candidates(599, position, travel) == []


# ---- one place ---------------------------------------------------------------------------------------------


def placed(apart_mm, offset_mm):
    return _place(apart_mm, np.asarray(offset_mm), np.full(len(offset_mm), 4e-4), REACH_MM)


def test_distances_on_both_sides_place_a_frame():
    apart = np.array([-0.5, -0.3, -0.1, 0.1, 0.3, 0.5])
    found = placed(apart, np.abs(apart + 0.14))
    assert found == pytest.approx(0.14, abs=0.02)


def test_a_place_that_could_be_either_of_two_is_not_taken():
    # All on one side and all alike: the frame may lie 0.3 mm before or behind.
    apart = np.array([0.0, 0.001, 0.002, 0.003])
    assert placed(apart, [0.3] * 4) is None


def test_frames_without_common_speckle_speak_against_a_place_near_them():
    apart = np.array([0.0, 0.001, 0.002, 0.003, 0.4, 0.45])
    found = placed(apart, [0.3] * 4 + [np.nan] * 2)
    assert found == pytest.approx(0.3, abs=0.03)
