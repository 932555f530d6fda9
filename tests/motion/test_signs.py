"""Signs and rough paths from unsigned planes made of known paths of position and slope."""

import numpy as np
import pytest

from speckle3d.motion.signs import OPEN_FRAMES, PLAIN_ERROR, Strangers, pair_signs, settled_path

REACH_MM, KEY_MM, TURNED_MM = 0.85, 0.2, 8.0
"""Pairs share speckle up to the first; the second apart, a key frame is kept; a slope's worth in travel."""
ADAPTED = 0.1
"""Relative error of distances where coherence has been adapted to."""


def uneven(frames, length_mm, seed=0):
    speed = np.clip(1 + 0.8 * np.sin(np.linspace(0, 19, frames - 1) + seed), 0.1, None)
    return length_mm * np.concatenate([[0], np.cumsum(speed) / speed.sum()])


def tremor(frames, rng):
    return 0.004 * rng.normal(size=frames)


def turning(frames, rng, largest=0.007):
    """Slow yaw of a hand, 0.4 degrees."""
    t = np.linspace(0, 1, frames)
    return largest * np.sin(2 * np.pi * (rng.uniform(0.5, 2) * t + rng.uniform()))


def one_way(rng, seed):
    z = uneven(50, 4.5, seed)
    return z, turning(z.size, rng)


def reversal(rng, seed):
    z = uneven(32, 2.7, seed)
    z = np.concatenate([z, z[-2::-1]])
    return z, turning(z.size, rng)


def pause(rng, seed):
    z = uneven(32, 2.7, seed)
    z = np.concatenate([z, 2.7 + tremor(15, rng), 2.7 + z[1:]])
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


def yaw_alone(rng, seed):
    return tremor(70, rng), 0.05 * np.sin(np.linspace(0, 4 * np.pi, 70))


SWEEPS = [one_way, reversal, pause, reversal_in_a_pause, there_and_back_twice, yaw_in_place]


def short(d):
    return 0.75 * d


def shorter_with_distance(d):
    """As coherent tissue reads: a distance and its halves do not add up."""
    return d * (1 - 0.25 * min(abs(d) / 0.5, 1.0))


class Sweep:
    """Pairs of a made sweep, as a reading in order meets them: two recent frames and some key frames."""

    def __init__(self, z, b, seed, read=lambda d: d, wrong=0.0, relative=0.03, slope_noise=2e-4):
        self.z, self.b = z, b
        self.read, self.wrong, self.relative, self.slope_noise = read, wrong, relative, slope_noise
        self.rng = np.random.default_rng(seed)
        self.first, self.second, self.is_wrong = [], [], []
        self.moved, self.covariance = [], []
        self._pair_up()

    def _pair_up(self):
        """Measure each frame in turn against earlier ones."""
        keys = []
        for frame in range(len(self.z)):
            near = [k for k in keys[-8:] if self._apart(k, frame) < REACH_MM]
            references = sorted({*range(max(0, frame - 2), frame), *near})
            self._left = len(references) // 3
            for k in references:
                self._measure(k, frame)
            if not keys or self._apart(keys[-1], frame) > KEY_MM:
                keys.append(frame)

    def _apart(self, i, j):
        return abs(self.z[j] - self.z[i]) + TURNED_MM * abs(self.b[j] - self.b[i])

    def _measure(self, i, j):
        z = self.z[j] - self.z[i]
        a = self.read(z) + self.rng.normal() * np.hypot(self.relative * z, 0.004)
        share = self.read(z) / z if abs(z) > 1e-9 else 1.0
        b = share * (self.b[j] - self.b[i]) + self.slope_noise * self.rng.normal()
        # Never most of a frame's pairs: those would place it wrongly, and rightly so.
        false = bool(self.rng.uniform() < self.wrong and self._left > 0)
        if false:
            self._left -= 1
            a, b = self.rng.uniform(-0.8, 0.8), 0.01 * self.rng.normal()
        side = 1.0 if a >= 0 else -1.0
        variance = [(self.relative * a) ** 2 + 0.02**2, self.slope_noise**2]
        self.first.append(i)
        self.second.append(j)
        self.is_wrong.append(false)
        self.moved.append([side * a, side * b])
        self.covariance.append(np.diag(variance))

    @property
    def signless(self):
        """Frames, offsets and slopes, and covariances of all pairs."""
        return tuple(np.array(x) for x in (self.first, self.second, self.moved, self.covariance))

    def resolve(self, relative_error=PLAIN_ERROR):
        return settled_path(len(self.z), *self.signless, relative_error)

    def wrong_signs(self, path, clear_mm=0.07, after=0):
        """Pairs with a clear sign that got the other, up to the mirror image of the whole."""
        first, second = np.array(self.first), np.array(self.second)
        z, b = self.z[second] - self.z[first], self.b[second] - self.b[first]
        sign, moved = pair_signs(path, *self.signless), np.array(self.moved)
        # Below three deviations either sign is as good.
        by_offset, by_slope = np.abs(z) > clear_mm, np.abs(b) > 0.006
        truth = np.where(by_offset, z * moved[:, 0], b * moved[:, 1])
        clear = (by_offset | (by_slope & (np.abs(z) < 0.02))) & ~np.array(self.is_wrong)
        # The first pair alone places its frame; a slope three deviations off, one in 370, mirrors it.
        clear &= (second > 1) & (first >= after)
        off = (sign * truth < 0)[clear]
        assert clear.sum() > len(self.z)
        return min(off.sum(), (~off).sum())


def failures(sweep, seeds=20, error=(), clear_mm=0.07, after=0, **noise):
    """Seeds of which any sign is wrong."""
    bad = []
    for seed in range(seeds):
        made = Sweep(*sweep(np.random.default_rng(100 + seed), seed), seed, **noise)
        if made.wrong_signs(made.resolve(*error), clear_mm, after):
            bad.append(seed)
    return bad


@pytest.mark.parametrize("sweep", SWEEPS)
def test_every_pair_that_is_apart_gets_its_sign(sweep):
    assert failures(sweep) == []


@pytest.mark.parametrize("sweep", [one_way, reversal_in_a_pause])
def test_signs_hold_where_distances_are_adapted_and_taken_as_better(sweep):
    assert failures(sweep, error=(ADAPTED,)) == []


@pytest.mark.parametrize("sweep", [reversal_in_a_pause, yaw_in_place])
def test_signs_hold_where_all_distances_are_a_quarter_short(sweep):
    assert failures(sweep, read=short) == []


@pytest.mark.parametrize("sweep", [reversal, reversal_in_a_pause])
def test_signs_hold_where_long_distances_are_a_quarter_short(sweep):
    """Frames are then misplaced by up to a quarter of the reach: the signs of shorter steps are not asked."""
    assert failures(sweep, read=shorter_with_distance, clear_mm=REACH_MM / 4) == []


@pytest.mark.parametrize("sweep", [one_way, reversal_in_a_pause, yaw_in_place])
def test_signs_hold_where_a_tenth_of_the_pairs_is_wrong(sweep):
    assert failures(sweep, wrong=0.1) == []


def test_a_probe_that_only_turns_gets_its_signs_from_slopes():
    """Offsets are noise. The first frames' are taken for the first motion, and their signs are not asked."""
    assert failures(yaw_alone, after=2) == []


@pytest.mark.parametrize("seed", range(1))
def test_a_sweep_longer_than_paths_are_kept_open(seed):
    rng = np.random.default_rng(seed)
    z = [
        uneven(300, 14.0, seed),
        14.0 + tremor(20, rng),
        14.0 - uneven(250, 12.0, seed),
        2.0 + tremor(15, rng),
    ]
    z = np.concatenate([*z, 2.0 - uneven(300, 10.0, seed)])
    assert z.size > 2 * OPEN_FRAMES
    made = Sweep(z, turning(z.size, rng), seed)
    path = made.resolve()
    assert made.wrong_signs(path) == 0
    # A random walk of pairs of some 0.4 mm, right to 3 %: 0.02 mm per root of mm.
    assert np.abs(np.abs(path[:, 0]) - np.abs(z)).max() < 0.02 * np.sqrt(36.0) * 4
    assert np.isfinite(path).all()


@pytest.mark.parametrize("direction", [1, -1])
def test_the_first_motion_counts_as_positive(direction):
    for seed in range(10):
        z = direction * uneven(60, 5.0, seed)
        made = Sweep(z, np.zeros(60), seed)
        path = made.resolve()
        # 3 % per pair of distances of a tenth to some tenths.
        np.testing.assert_allclose(path[:, 0], np.abs(z), atol=0.25)
        assert (np.diff(path[:, 0]) > -0.03).all()


def test_the_path_holds_position_and_slope():
    z, b = yaw_in_place(np.random.default_rng(3), 3)
    made = Sweep(z, b, 3, relative=0.005, slope_noise=2e-5)
    path = made.resolve()
    # Without errors but the 0.004 mm and 0.5 % of each of some dozen pairs in a row.
    np.testing.assert_allclose(path[:, 0], z, atol=0.06)
    np.testing.assert_allclose(path[:, 1] - path[0, 1], b - b[0], atol=5e-4)


def test_what_comes_later_settles_what_was_open():
    """After a stop two paths lie open; the frame that sees one from before the stop decides, backwards."""
    z = np.array([0.0, 0.2, 0.4, 0.42, 0.3, 0.1])
    # Frame 4 is measured against the last two alone, which a turn and going on suit nearly alike.
    seen = {1: [0], 2: [0, 1], 3: [1, 2], 4: [3], 5: [0, 1, 4]}
    first, second = np.array([(i, frame) for frame, earlier in seen.items() for i in earlier]).T
    moved = np.column_stack([np.abs(z[second] - z[first]), np.zeros(first.size)])
    covariance = np.tile(np.diag([0.02**2, 1e-8]), (first.size, 1, 1))

    def path(frames):
        some = second < frames
        return settled_path(frames, first[some], second[some], moved[some], covariance[some], ADAPTED)

    # Hands turn back rarely: at frame 4 going on is the better guess, at frame 5 it no longer is.
    assert path(5)[4, 0] > 0.42
    np.testing.assert_allclose(path(6)[:, 0], z, atol=0.02)


def test_a_pair_has_the_sign_with_which_offset_and_slope_together_agree():
    """The offset is within its error of none; the slope tells."""
    path = np.array([[0.0, 0.0], [0.01, -0.02], [0.3, 0.0]])
    cross, ahead = ([0.01, 0.02], [4e-4, 4e-8]), ([0.31, -0.001], [4e-4, 4e-6])
    moved, variance = zip(cross, ahead, ahead, strict=True)
    covariance = np.array([np.diag(v) for v in variance])
    signs = pair_signs(path, np.array([0, 0, 2]), np.array([1, 2, 0]), np.array(moved), covariance)
    assert signs.tolist() == [-1.0, 1.0, -1.0]


def wobbled(seed, told):
    """Clear steps of a wobble, which are as long as speckle lasts, that get the wrong sign."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(60) / 25.0
    z = 0.5 * np.sin(2.0 * np.pi * 3.0 * time_s + rng.uniform(0.0, 2.0 * np.pi)) + 2.5 * time_s
    z = (z - z[0]) * np.sign(z[1] - z[0])
    pairs, strangers = [], []
    for frame in range(1, z.size):
        before = np.arange(max(0, frame - 8), frame)
        apart = np.abs(z[frame] - z[before])
        near = sorted({frame - 1, *before[apart < 0.35]})
        read = np.abs(z[frame] - z[near]) * (1.0 + 0.05 * rng.standard_normal(len(near))) + 0.005
        pairs += [(i, frame, d) for i, d in zip(near, read, strict=True)]
        strangers += [(i, frame) for i in before[apart > 0.6]]
    first, second, read = np.array(pairs).T
    moved = np.column_stack([read, np.zeros(read.size)])
    known = np.tile(np.diag([0.03**2, 1e-8]), (read.size, 1, 1))
    unlike = Strangers(*np.array(strangers).T, 0.3) if told else None
    path = settled_path(z.size, first.astype(int), second.astype(int), moved, known, ADAPTED, unlike)
    step, true = np.diff(path[:, 0]), np.diff(z)
    return int(((np.sign(step) != np.sign(true)) & (np.abs(true) > 0.05)).sum())


def test_frames_that_do_not_resemble_each_other_are_apart():
    seeds = (2, 3, 4)
    assert sum(wobbled(seed, told=True) for seed in seeds) == 0
    assert sum(wobbled(seed, told=False) for seed in seeds) > 10
