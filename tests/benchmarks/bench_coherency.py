"""Coherent share of a patch: from its own axial and lateral correlation, or from the sweep's pairs.

Run: ``python tests/benchmarks/bench_coherency.py [--seeds 21 22 23 24] [--phantoms 21 22] [--frames 24]``.

Gee et al. (2006) infer from correlation along the frame's own axes how coherently a patch scatters; the
package infers it from pairs of frames far apart (speckle3d.motion.coherence). The truth here is the share
that explains a simulation's elevational decorrelation at true distances. It is fitted to correlations which
the package reads too: their agreement is high by construction, lengths are the fair comparison. What is
learnt is learnt on one half of the tissue sweeps and used on the other; phantoms, without coherence, get what
all tissue taught. All tissue follows one recipe with layers at like depths: "depth" is what is learnt without
measuring, and nothing here tells of tissue built otherwise.
"""

import argparse
import os
from dataclasses import dataclass, replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from bench_accuracy import CURVE_SEEDS, STEPPED, VECTORS, curves_of
from cache import DEFAULT, simulated
from scipy.stats import linregress, spearmanr

from speckle3d.config import Config
from speckle3d.core.geometry import FloatArray
from speckle3d.io.load import load_sweep
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.distances import DistanceEstimator
from speckle3d.motion.matching import FrameMatcher
from speckle3d.simulation.presets import SimulationSettings
from speckle3d.solution import Solution
from speckle3d.study.metrics import accumulated
from speckle3d.walk import Walk

ROUNDS, LAGS = 3, (1, 2, 3, 4)
DEPTHS_MM = ((0, 11), (11, 20), (20, 29), (29, 45), (0, 45))
IN_FRAME = ("lateral", "axial", "far", "contrast")
LEARNT = {
    "depth": ("depth",),
    "in-frame": ("1", *IN_FRAME),
    "in-frame, squares, through 0": (*IN_FRAME, *(f"{name}^2" for name in IN_FRAME)),
    "package, through 0": ("package",),
    "package, in-frame, through 0": ("package", *IN_FRAME),
}
"""Features exceed the phantom's by zero in a phantom, where a share learnt through zero is zero, too."""
STRUCTURE_MM, REDUNDANCY, GAIN_PRECISION = 10.0, 20.0, 40.0
CONFIG = Config.model_validate({"sensors": {"consistent_subset": False}})
HALF_BLOCK = CONFIG.coherence.block_frames / 2


@dataclass(frozen=True)
class Reading:
    """A sweep, or a piece of one, after the first reading; features by name, each of shape (block, p)."""

    solution: Solution
    package: Coherence
    position_mm: FloatArray
    true: Coherence
    features: dict[str, FloatArray]


def frame_statistics(image: FloatArray, patches) -> FloatArray:
    """Correlation of each patch with itself at lateral, then axial lags, and its contrast; shape (p, k)."""
    (v, s), axes = patches.size, (1, 2)
    tiles = np.stack([image[a : a + v, b : b + s] for a, b in patches.first]).astype(float)
    pairs = [(tiles[:, :-k], tiles[:, k:]) for k in LAGS] + [(tiles[..., :-k], tiles[..., k:]) for k in LAGS]
    pairs = [[x - x.mean(axes, keepdims=True) for x in pair] for pair in pairs]
    rho = [(a * b).sum(axes) / np.sqrt((a * a).sum(axes) * (b * b).sum(axes)) for a, b in pairs]
    return np.stack([*rho, tiles.std(axes) / tiles.mean(axes)], axis=1)


class Bench:
    """Curves, and the statistics of the phantom they come from."""

    def __init__(self) -> None:
        self.curves = curves_of(DEFAULT)
        sweeps = [load_sweep(simulated(SimulationSettings(seed=s, **STEPPED))) for s in CURVE_SEEDS]
        self.matcher = FrameMatcher(sweeps[0], CONFIG.intensity, CONFIG.patches, CONFIG.inplane)
        self.depth_mm = self.matcher.patches.centre_mm[:, 1]
        # Every ninth frame: half a millimetre on, speckle is new.
        each = np.concatenate([self.prepare([s.frames[k] for k in range(0, len(s), 9)])[1] for s in sweeps])
        self.phantom = np.stack([each[:, self.depth_mm == d].mean((0, 1)) for d in self.depth_mm])

    def prepare(self, frames: list[np.ndarray]) -> tuple[list, FloatArray]:
        """Frames made ready for matching, and their statistics, shape (n, p, k)."""
        ready = [self.matcher.prepare(self.matcher.intensity(frame)) for frame in frames]
        return ready, np.stack([frame_statistics(r.image, self.matcher.patches) for r in ready])

    def read(self, sweep, sizes: list[int]) -> dict[int, list[Reading]]:
        """Readings of a sweep, as size 0, and of its pieces, which get their truth from the whole."""
        frames = [sweep.frames[k] for k in range(len(sweep))]
        ready, statistics = self.prepare(frames)
        readings: dict[int, list[Reading]] = {size: [] for size in (0, *sizes)}
        for size, found in readings.items():
            length = size or len(sweep)
            for start in range(0, len(sweep) - length + 1, length):
                k = slice(start, start + length)
                part = {"frame_time_s": sweep.frame_time_s[k], "truth": sweep.truth[k]}
                piece = replace(sweep, frames=np.stack(frames[k]), **part)
                true = [replace(r.true, frame=r.true.frame - start) for r in readings[0]]
                found.append(self._read_one(piece, ready[k], statistics[k], *true))
        return readings

    def _read_one(self, sweep, ready: list, statistics: FloatArray, true=None) -> Reading:
        walk = Walk(sweep, self.matcher, DistanceEstimator(self.curves, self.matcher.patches), CONFIG)
        for number, frame in enumerate(ready):
            walk.advance(number, frame)
        solution = Solution(walk, self.curves)
        package, position = solution._coherence, solution._position
        near = np.abs(np.arange(len(ready)) - package.frame[:, None]) <= HALF_BLOCK
        features = self._features(np.stack([statistics[k].mean(axis=0) for k in near]))
        features |= {f"{name}^2": value * np.abs(value) for name, value in features.items()}
        depth = 1.0 * (self.depth_mm[:, None] == np.unique(self.depth_mm)) + 0 * package.share[..., None]
        features |= {"package": package.share, "1": np.ones_like(package.share), "depth": depth}
        true = with_share(package, *(true or self._true_shares(walk, package)).at(package.frame))
        return Reading(solution, package, position, true, features)

    def _features(self, block: FloatArray) -> dict[str, FloatArray]:
        """How far each statistic exceeds the phantom's; a correlation as a share of what is left to one."""
        excess, count = block - self.phantom, len(LAGS)
        excess[..., :-1] /= 1 - self.phantom[:, :-1]
        half = np.abs(self.phantom[:, :-1].reshape(-1, 2, count) - 0.5).argmin(axis=2)
        lags = {"lateral": half[:, 0], "axial": count + half[:, 1], "far": half[:, 0] + 1, "contrast": -1}
        return {name: excess[:, np.arange(len(half)), lag] for name, lag in lags.items()}

    def _true_shares(self, walk: Walk, like: Coherence) -> Coherence:
        """Shares and gains at each patch's true distance from the first frame's plane."""
        here, truth, table, rows = self.curves.at(self.depth_mm), walk.sweep.truth, walk.table, []
        for row, (i, j) in enumerate(zip(table.first, table.second, strict=True)):
            motion, centre = table.motion(row), self.matcher.patches.centre_mm
            points = np.column_stack([centre - [motion.x_mm, motion.y_mm], np.zeros(len(centre))])
            rows.append(np.abs((truth[i].inv() * truth[j]).apply(points)[:, 2]))
        distance, middle = np.stack(rows), (table.first + table.second) / 2
        columns = zip(distance.T, here.correlation**0.5, strict=True)
        g = np.stack([np.interp(d, here.distance_mm, curve) for d, curve in columns], axis=1)
        blocks, h = [np.abs(middle - c) <= HALF_BLOCK for c in like.frame], np.exp(-distance / STRUCTURE_MM)
        fits = [fit_share(table.correlation[k], g[k], h[k], here.cells) for k in blocks]
        return with_share(like, *np.stack(fits, axis=1))


def fit_share(rho: FloatArray, g: FloatArray, h: FloatArray, cells: FloatArray) -> FloatArray:
    """Share and gain in rho = gain (c h + (1 - c) g)^2 by Gauss-Newton; all (e, p), result (2, p)."""
    c, gain = np.full(rho.shape[1], 0.1), np.ones(rho.shape[1])
    for _ in range(10):
        echo = c * h + (1 - c) * g
        left = np.nan_to_num(rho - gain * echo**2)
        noise = REDUNDANCY * ((1 - np.minimum(gain * echo**2, 1) ** 2) ** 2 / cells + 1e-3)
        slopes = np.stack([2 * gain * echo * (h - g), echo**2])
        known, prior = np.isfinite(rho) / noise, np.diag([0.1, GAIN_PRECISION])
        normal = np.einsum("iep,jep,ep->pij", slopes, slopes, known) + prior
        right = np.einsum("iep,ep->pi", slopes, left / noise) - np.outer(GAIN_PRECISION * (gain - 1), [0, 1])
        step = 0.8 * np.linalg.solve(normal, right[..., None])[..., 0]
        c, gain = np.clip(c + step[:, 0], 0, 0.97), np.clip(gain + step[:, 1], 0.1, 1.03)
    return np.stack([c, gain])


def with_share(like: Coherence, share: FloatArray, gain: FloatArray | float = 1.0) -> Coherence:
    return replace(like, share=share, gain=gain + np.zeros_like(share), structure_mm=STRUCTURE_MM)


def length_error(reading: Reading, coherence: Coherence | None) -> float:
    """Error of the length, in percent, that the package's second reading gives with other shares."""
    solution, walk, package = reading.solution, reading.solution._walk, coherence is reading.package
    position, centre = reading.position_mm if package else walk.position_mm, walk.sweep.grid.centre_mm
    for _ in range(1 if package or coherence is None else ROUNDS):
        # Pairs are chosen by distance, which other shares change: choose anew at those just found.
        solution._coherence, solution._position = coherence, position
        position = accumulated(solution.solve(None).image, centre).length_mm
    return 100 * (abs(position[-1] / accumulated(walk.sweep.truth, centre).length_mm[-1]) - 1)


def learn(readings: list[Reading], names: tuple[str, ...]):
    """Least squares of the true share on features; returns what predicts another reading's share."""

    def design(r: Reading) -> FloatArray:
        return np.hstack([r.features[name].reshape(r.true.share.size, -1) for name in names])

    true = np.concatenate([r.true.share.ravel() for r in readings])
    weights = np.linalg.lstsq(np.vstack([design(r) for r in readings]), true, rcond=None)[0]
    return lambda r: np.clip(design(r) @ weights, 0.0, 0.95).reshape(r.true.share.shape)


def report_agreement(readings: list[Reading], depth_mm: FloatArray) -> None:
    true = np.concatenate([r.true.share for r in readings])
    values = {n: np.concatenate([r.features[n] for r in readings]) for n in (*IN_FRAME, "package")}
    print("against the true share: rank correlation; of shares, clipped, also slope on it and rms difference")
    print(f"  {'':14}{'mean':>5}" + "".join(f"{name:>17}" for name in values))
    for low, high in DEPTHS_MM:
        k = (depth_mm >= low) & (depth_mm < high)
        cells = "".join(_agreement(n, v[:, k].ravel(), true[:, k].ravel()) for n, v in values.items())
        print(f"  {f'{low}-{high} mm':14}{true[:, k].mean():5.2f}{cells}")
    rows = [depth_mm == d for d in depth_mm]
    within = [(v - [v[:, k].mean() for k in rows]).ravel() for v in (true, *values.values())]
    print(f"  {'less row means':19}" + "".join(_agreement("", v, within[0]) for v in within[1:]))


def _agreement(name: str, value: FloatArray, true: FloatArray) -> str:
    rank, share = spearmanr(value, true).statistic, np.clip(value, 0, 1)
    slope, rms = linregress(true, share).slope, np.sqrt(np.mean((share - true) ** 2))
    return f"{rank:6.2f}" + (f"{slope:6.2f}{rms:5.2f}" if name not in ("far", "contrast", "") else " " * 11)


def report_lengths(sweeps: list[list[Reading]], learnt: list[dict], tissue: int) -> None:
    found = {}
    for number, (readings, models) in enumerate(zip(sweeps, learnt, strict=True)):
        for r in readings:
            lateral, axial = (np.clip(r.features[name], 0, 0.95) for name in ("lateral", "axial"))
            shares = {"c_l": lateral, "(c_a + c_l) / 2": (lateral + axial) / 2}
            shares |= {f"learnt: {name}": predict(r) for name, predict in models.items()}
            ways = {name: with_share(r.true, share) for name, share in shares.items()}
            ways = {"none": None, "package": r.package, **ways, "true": r.true}
            for name, way in ways.items():
                square = np.mean(((0 if way is None else way.share) - r.true.share) ** 2)
                found.setdefault(name, []).append((number, length_error(r, way), square))
    for name, rows in found.items():
        number, error, square = np.array(rows).T
        each = "".join(f"{error[number == k].mean():7.1f}" for k in range(len(sweeps)))
        e, rms = error[number < tissue], np.sqrt(square[number < tissue].mean())
        print(f"  {name:38}{rms:8.2f}{each}  {e.mean():6.1f}{e.std():6.1f}{np.sqrt((e**2).mean()):6.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22, 23, 24], help="tissue")
    parser.add_argument("--phantoms", type=int, nargs="*", default=[21, 22], help="seeds of phantoms")
    parser.add_argument("--frames", type=int, nargs="*", default=[24], help="of short pieces of tissue")
    options = parser.parse_args()
    bench, tissue = Bench(), len(options.seeds)
    wanted = [("tissue", seed) for seed in options.seeds] + [("phantom", seed) for seed in options.phantoms]
    read, heads = [], "".join(f"{preset[0]}{seed}".rjust(7) for preset, seed in wanted)
    for preset, seed in wanted:
        path = simulated(SimulationSettings(preset=preset, seed=seed, vectors=VECTORS, length_mm=20.0))
        read.append(bench.read(load_sweep(path), options.frames if preset == "tissue" else []))
    report_agreement([each[0][0] for each in read[:tissue]], bench.depth_mm)
    halves = [2 * k // tissue for k in range(len(read))]
    for size in (0, *options.frames):
        sweeps, learnt = [each[size] for each in read if size in each], []
        for half in halves[: len(sweeps)]:
            others = [r for k in range(tissue) if halves[k] != half for r in sweeps[k]]
            learnt.append({name: learn(others, used) for name, used in LEARNT.items()})
        print(f"\nlength error %, {f'pieces of {size} frames' if size else 'whole sweeps'}")
        print(f"  {'share from':37}rms of it{heads[: 7 * len(sweeps)]}   tissue's mean, sd, rms")
        report_lengths(sweeps, learnt, tissue)


if __name__ == "__main__":
    main()
