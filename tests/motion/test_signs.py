"""Signs and rough paths from unsigned planes made of known paths of position and slope."""

from dataclasses import replace

import numpy as np
import pair_planes
import pytest

from speckle3d.motion.signs import Strangers, likeliest_path, on_path

REACH_MM, KEY_MM, TURN_MM = 0.85, 0.2, 8.0
"""Pairs share speckle up to the first; the second apart, a key frame is kept; a slope's worth in travel."""
NO_STRANGERS = Strangers(np.zeros(0, int), np.zeros(0, int), 0.0, 0.0)


def planes_of(first, second, steps, covariance):
    """Planes of pairs whose slope along y is nothing."""
    full_covariance = np.tile(np.eye(3), (len(steps), 1, 1))
    full_covariance[:, :2, :2] = covariance
    return pair_planes.from_coefficients(
        first, second, np.column_stack([steps, np.zeros(len(steps))]), full_covariance
    )


def uneven(frames, length_mm, seed=0):
    speed = np.clip(1 + 0.8 * np.sin(np.linspace(0, 19, frames - 1) + seed), 0.1, None)
    return length_mm * np.concatenate([[0], np.cumsum(speed) / speed.sum()])


def tremor(frames, rng):
    return 0.004 * rng.normal(size=frames)


def turning(frames, rng):
    """Slow yaw of a hand, 0.4 degrees."""
    t = np.linspace(0, 1, frames)
    return 0.007 * np.sin(2 * np.pi * (rng.uniform(0.5, 2) * t + rng.uniform()))


def one_way(rng, seed):
    z = uneven(50, 4.5, seed)
    return z, turning(z.size, rng)


def reversal_in_a_pause(rng, seed):
    z = uneven(32, 2.7, seed)
    z = np.concatenate([z, 2.7 + tremor(15, rng), z[::-1]])
    return z, turning(z.size, rng)


def there_and_back_twice(rng, seed):
    z = 1.5 * np.sin(np.linspace(0, 4 * np.pi, 80))
    return z, turning(z.size, rng)


def yaw_in_place(rng, seed):
    """On the way the probe stops and is turned 3 degrees to either side: planes that cross, a about zero."""
    z = uneven(32, 2.7, seed)
    z = np.concatenate([z[:16], z[15] + tremor(36, rng), z[15:]])
    b = turning(z.size, rng)
    b[16:52] += 0.05 * np.sin(np.linspace(0, 4 * np.pi, 36))
    return z, b


SWEEPS = [one_way, reversal_in_a_pause, there_and_back_twice, yaw_in_place]


def read_pairs(z, b, seed, wrong):
    """Frames, truth and readings of pairs: of each frame with two recent ones and some key frames."""
    rng, keys, rows = np.random.default_rng(seed), [], []

    def apart(i, j):
        return abs(z[j] - z[i]) + TURN_MM * abs(b[j] - b[i])

    for frame in range(len(z)):
        near = [k for k in keys[-8:] if apart(k, frame) < REACH_MM]
        references = sorted({*range(max(0, frame - 2), frame), *near})
        # Never most of a frame's pairs: those would place it wrongly, and rightly so.
        most_false = len(references) // 3
        for k in references:
            step = z[frame] - z[k]
            offset = step + rng.normal() * np.hypot(0.03 * step, 0.004)
            slope = b[frame] - b[k] + 2e-4 * rng.normal()
            is_false = rng.uniform() < wrong and most_false > 0
            if is_false:
                most_false -= 1
                offset, slope = rng.uniform(-0.8, 0.8), 0.01 * rng.normal()
            side = 1.0 if offset >= 0 else -1.0
            covariance = np.diag([(0.03 * offset) ** 2 + 0.02**2, 2e-4**2])
            rows.append((k, frame, is_false, [side * offset, side * slope], covariance))
        if not keys or apart(keys[-1], frame) > KEY_MM:
            keys.append(frame)
    return (np.array(column) for column in zip(*rows, strict=True))


def wrong_signs(z, b, seed, wrong):
    """Pairs with a clear sign that got the other, up to the mirror image of the whole."""
    first, second, is_false, *readings = read_pairs(z, b, seed, wrong)
    planes, frames = planes_of(first, second, *readings), len(z)
    steps = on_path(planes, likeliest_path(planes, frames, NO_STRANGERS)).coefficients[:, :2]
    z, b = z[second] - z[first], b[second] - b[first]
    # Below three deviations either sign is as good.
    by_offset, by_slope = np.abs(z) > 0.07, np.abs(b) > 0.006
    truth = np.where(by_offset, z * steps[:, 0], b * steps[:, 1])
    clear = (by_offset | (by_slope & (np.abs(z) < 0.02))) & ~is_false
    # The first pair alone places its frame; a slope three deviations off, one in 370, mirrors it.
    clear &= second > 1
    off = (truth < 0)[clear]
    assert clear.sum() > frames
    return min(off.sum(), (~off).sum())


def failures(sweep, wrong=0.0):
    """Seeds of which any sign is wrong."""
    paths = (sweep(np.random.default_rng(100 + seed), seed) for seed in range(12))
    return [seed for seed, path in enumerate(paths) if wrong_signs(*path, seed, wrong)]


@pytest.mark.parametrize("sweep", SWEEPS)
def test_every_pair_that_is_apart_gets_its_sign(sweep):
    assert failures(sweep) == []


@pytest.mark.parametrize("sweep", [one_way, reversal_in_a_pause, yaw_in_place])
def test_signs_hold_where_a_tenth_of_the_pairs_is_wrong(sweep):
    assert failures(sweep, wrong=0.1) == []


def resting_errors(seed, is_known):
    """Share of near pairs on the wrong side where a probe trembles in place and a bias feigns yaw."""
    rng = np.random.default_rng(seed)
    speed = np.where(np.abs(np.arange(39) - 20) < 5, 0.012 * rng.standard_normal(39), 0.12)
    path = np.cumsum(np.column_stack([speed, 0.0005 * rng.standard_normal(39)]), axis=0)
    first, second = np.array([(i, k) for k in range(1, 39) for i in range(max(0, k - 6), k)]).T
    steps = path[second] - path[first]
    feigned = 0.4 * 0.02**2 / (2.0 * np.maximum(np.abs(steps[:, 0]), 0.02)) / 5.0
    read = steps + np.stack([np.full(first.size, 0.005), feigned], axis=1) * rng.standard_normal(steps.shape)
    read *= np.where(read[:, :1] < 0.0, -1.0, 1.0)
    planes = planes_of(first, second, read, np.diag([0.02, 1.5e-4]) ** 2)
    planes = replace(planes, feigned_yaw=feigned * is_known)
    signed = on_path(planes, likeliest_path(planes, 39, NO_STRANGERS)).coefficients[:, :2]
    # Yaw counts by what it moves 6 mm from the image's centre.
    agreement = (signed * steps) @ [1.0, 6.0**2]
    return np.mean(agreement[np.abs(steps[:, 0]) < 0.04] < 0)


def test_a_resting_probe_is_put_on_its_side_where_a_bias_feigns_yaw():
    """Measured: 19 % wrong, and 34 where nothing is said of it."""
    with_bias, without = (np.mean([resting_errors(seed, k) for seed in range(12)]) for k in (True, False))
    assert with_bias < 0.25
    assert without > 0.28


def wobble_errors(seed, with_strangers):
    """Clear steps of a wobble, which are as long as speckle lasts, that get the wrong sign."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(60) / 25.0
    z = 0.3 * np.sin(2.0 * np.pi * 3.0 * time_s + rng.uniform(0.0, 2.0 * np.pi)) + 2.5 * time_s
    z = (z - z[0]) * np.sign(z[1] - z[0])
    yaw = 0.02 * np.sin(2.0 * np.pi * time_s)
    pairs, strangers = [], []
    for frame in range(1, z.size):
        before = np.arange(max(0, frame - 8), frame)
        apart = np.abs(z[frame] - z[before])
        near = sorted({frame - 1, *before[apart < 0.35]})
        move = z[frame] - z[near]
        read = np.abs(move) * (1.0 + 0.05 * rng.standard_normal(move.size)) + 0.005
        turn = np.sign(move) * (yaw[frame] - yaw[near])
        pairs += zip(near, [frame] * move.size, read, turn, strict=True)
        strangers += [(i, frame) for i in before[apart > 0.6]]
    first, second, *steps = np.array(pairs).T
    unlike = Strangers(*np.array(strangers).T, 0.3, 5.0) if with_strangers else NO_STRANGERS
    planes = planes_of(*np.array([first, second], int), np.transpose(steps), np.diag([0.03, 0.02]) ** 2)
    path = likeliest_path(planes, z.size, unlike)
    step, true = np.diff(path[:, 0]), np.diff(z)
    return int(((np.sign(step) != np.sign(true)) & (np.abs(true) > 0.05)).sum())


def test_frames_that_do_not_resemble_each_other_are_apart():
    """Measured: 3, and 138 where nothing is said of strangers; 93 without those that turn by 0.01 rad."""
    with_strangers, without = (sum(wobble_errors(seed, w) for seed in range(6)) for w in (True, False))
    assert with_strangers <= 4
    assert without > 80
