"""What no honest sweep shows, on tables of correlations made for the purpose."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from speckle import curves

from speckle3d.examine.images import (
    doubt_clutter,
    doubt_connection,
    doubt_length,
    doubt_order,
    doubt_path,
    far_apart,
)
from speckle3d.matching.schedule import PairSchedule, TrajectorySettings
from speckle3d.matching.table import CorrelationTable

WIDTH_MM, CELLS, PAIRS = 0.45, 60.0, 100
PATCHES_MM = np.array([[x, y] for x in (2.0, 6.0, 10.0) for y in np.linspace(5.0, 25.0, 9)])


def table_of(position_mm, gain=1.0, source=None):
    """The pairs that the schedule wants; `source`: which tissue each frame shows."""
    rng, schedule = np.random.default_rng(0), PairSchedule(TrajectorySettings())
    source = np.zeros(len(position_mm)) if source is None else source
    rows = []
    for frame in range(len(position_mm)):
        correlations = {}
        for first in schedule.references(frame):
            rho = gain * np.exp(-((position_mm[frame] - position_mm[first]) ** 2) / (2 * WIDTH_MM**2))
            rho *= source[frame] == source[first]
            correlations[first] = float(np.clip(rho + 0.03 * (1 - rho) * rng.standard_normal(), 0.0, 1.0))
        rows += [(first, frame, correlations[first]) for first in sorted(correlations)]
        schedule.settle(frame, correlations)
    first, second, median = (np.array(column) for column in zip(*rows, strict=True))
    correlation = np.repeat(median[:, None], len(PATCHES_MM), axis=1).astype(np.float32)
    nothing = np.zeros((len(rows), 3)), np.tile(np.eye(3), (len(rows), 1, 1))
    return CorrelationTable(first, second, correlation, *nothing)


def along(position_mm):
    zero = np.zeros_like(position_mm)
    return RigidTransform.from_translation(np.column_stack([zero, zero, position_mm]))


SWEEP = np.linspace(0.0, 10.0, 80)
HONEST = {
    "one way": SWEEP,
    "fast": np.linspace(0.0, 10.0, 28),
    "there and back": np.concatenate([SWEEP[:40], SWEEP[40::-1]]),
    "a third at rest": np.concatenate([np.zeros(40), SWEEP]),
    "wobbling by hand": SWEEP + 0.3 * np.sin(2 * np.pi * 3.0 * np.arange(80) / 25.0),
    "at rest": np.zeros(60),
}


@pytest.mark.parametrize("motion", HONEST)
@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_honest_sweeps_are_not_doubted(motion, gain):
    position = HONEST[motion]
    table, usable = table_of(position, gain=gain), np.ones(position.size, dtype=bool)
    assert doubt_order(table, position.size, 0.2) is None
    assert doubt_path(table, along(position), PATCHES_MM, usable) is None
    assert doubt_connection(table.first[table.median > 0.2], table.second[table.median > 0.2], usable) is None


@pytest.mark.parametrize("sweeps", [2, 3])
def test_sweeps_recorded_in_turn_are_refused(sweeps):
    count = 40
    position = np.repeat(np.linspace(0.0, 5.0, count), sweeps)
    doubt = doubt_order(table_of(position, source=np.tile(np.arange(sweeps), count)), position.size, 0.2)
    assert doubt is not None
    assert doubt.refuted
    assert "interleaved" in doubt.suspect


def test_a_path_that_turns_where_the_images_do_not_is_doubted():
    # Pairs across a turn are as alike as others and on this path nearer to each other.
    once, often = np.where(SWEEP < 6.0, SWEEP, 12.0 - SWEEP), np.abs((SWEEP + 0.5) % 1.0 - 0.5)
    for path, refutes in ((once, False), (often, True)):
        doubt = doubt_path(table_of(SWEEP), along(path), PATCHES_MM, np.ones(SWEEP.size, dtype=bool))
        assert doubt is not None
        assert doubt.refuted == refutes
        ((first, last),) = doubt.frames
        assert f"about frame {(first + last + 1) // 2}" in doubt.evidence
        if path is once:
            # The turn lies at 6 of 12 mm.
            assert first <= np.searchsorted(SWEEP, 6.0) <= last + 1


@pytest.mark.parametrize(
    ("length_mm", "sigma_mm", "refutes"),
    [(3.58, 12111.0, True), (12.0, 6.5, True), (12.0, 4.0, False), (0.1, 2.6, True)],
)
def test_a_length_that_is_left_open_is_doubted(length_mm, sigma_mm, refutes):
    position = np.linspace(0.0, length_mm, 20)
    doubt = doubt_length(position, np.linspace(0.0, sigma_mm, 20), 2.5)
    assert doubt is not None
    assert doubt.refuted == refutes
    assert f"{sigma_mm:.3g} mm" in doubt.evidence


def test_frames_far_apart_are_beyond_the_reach_of_speckle():
    gaussian, frames = curves(sigma_mm=WIDTH_MM), np.arange(0, 230, 15)
    position = np.concatenate([np.zeros(30), np.linspace(0.0, 30.0, 200)])
    distant_frames = far_apart(position, frames, gaussian)
    assert len(distant_frames) > 80
    # exp(-d^2 / 2 w^2) is 0.03 at d = 2.65 w.
    assert np.abs(np.diff(position[distant_frames])).min() >= 2.6 * WIDTH_MM
    assert far_apart(np.zeros(230), frames, gaussian).size == 0


@pytest.mark.parametrize(
    ("share", "refutes"),
    [
        (np.full(50, 0.02), False),
        (np.r_[np.full(5, 0.3), np.zeros(45)], False),
        (np.full(50, 0.09), False),
        (np.full(50, 0.2), True),
        (np.r_[np.full(10, 0.5), np.zeros(40)], False),
        (np.r_[np.full(26, 0.5), np.zeros(24)], True),
    ],
)
def test_echoes_that_stand_still_are_doubted(share, refutes):
    doubt = doubt_clutter(share, PAIRS, CELLS)
    assert doubt is not None
    assert doubt.refuted == refutes


def test_a_sweep_in_pieces_is_flagged_at_each_cut():
    usable = np.ones(30, dtype=bool)
    usable[[10, 20]] = False
    chain = np.array([(k, k + 1) for k in range(29) if k + 1 not in (10, 20)])
    doubt = doubt_connection(chain[:, 0], chain[:, 1], usable)
    assert doubt is not None
    assert not doubt.refuted
    assert doubt.frames == ((10, 10), (20, 20))
