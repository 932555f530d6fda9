"""How close distances come to the Cramer-Rao bound: from intensity, from amplitude, from complex echoes.

Run: ``python tests/benchmarks/bench_efficiency.py`` (a minute or two on one core; sweeps are cached).

The echoes of N independent cells of fully developed speckle in two frames are complex Gaussian pairs of equal
power P, unknown, and coherence r(d). Their covariance's eigenvalues P(1+r), P(1-r) give r the information
N/(1+r)^2 + N/(1-r)^2 = 2N(1+r^2)/(1-r^2)^2 with P known; 2N r^2/(1-r^2)^2 of it is shared with ln P and lost
with P unknown, none with the phase or the ratio of powers. So the deviation of a distance is at least

    (1-r^2) / (sqrt(2N) |r'(d)|).

N is a patch's area over the integral of the speckle's squared autocorrelation, both axes, within the patch:
cells of speckle as it is. Whitening its spectrum makes more, so a whitened method may be below one. Complex
correlations are read in the same patches at the same shift as the package's of intensity, and squared: fully
developed speckle has rho_I = |rho_c|^2. Each method has curves of its own. Tables hold the deviation of a
patch's distance over that bound and (the bias in micrometres), where |rho_c|^2 is still 0.2 at the truth.
"""

import os
import sys
import timeit
from functools import lru_cache
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import inplane_twin
import numpy as np
from bench_accuracy import CURVE_SEEDS, STEPPED, VECTORS
from cache import simulated
from numpy.polynomial import Polynomial
from patch_kernels import patch_correlations
from scipy import fft
from scipy.interpolate import CubicSpline

from speckle3d.config import Config
from speckle3d.io.load import load_sweep
from speckle3d.matching.inplane import InPlaneMotion
from speckle3d.matching.matcher import Echo, FrameMatcher, MatchingSettings
from speckle3d.simulation.presets import SimulationSettings

HAND_SEEDS = (21, 22)
INTENSITY = MatchingSettings(correlate="intensity")
COUNT, STEP_MM = STEPPED["steps"], STEPPED["step_mm"]
TESTED_STEPS = (2, 4, 6, 8, 10)
CURVE_STEPS = (*range(1, 11), *range(12, 23, 2))
DEPTHS_MM = {"near": (0, 13), "focus": (13, 27), "deep": (27, 45)}
REACH = 0.2
GRID_MM = np.linspace(0.0, 2.0, 401)
STRAIN = 0.005


def parts(echo):
    """Rows of real and imaginary parts, of an echo and of the same turned by a quarter, for the kernel."""
    both = (np.stack([z.real, z.imag], axis=1) for z in (echo, -1j * echo))
    return [np.ascontiguousarray(z.reshape(2 * len(echo), -1), dtype=np.float32) for z in both]


def correlations(fixed, moving, first, size, lag, rows=3):
    """Correlation at the lags about `lag`, shape (p, rows, 3)."""
    out = np.empty((len(first), rows, 3))
    patch_correlations(fixed, moving, first, size, lag, 0.6, out)
    return out


def coherences(fixed, moving, first, size, lag):
    """|rho_c|^2 of parts likewise; odd rows of lags pair real parts with imaginary ones: left out."""
    doubled = first * [2, 1], size * [2, 1], lag * [2, 1]
    return sum(correlations(fixed[0], image, *doubled, rows=5)[:, ::2] ** 2 for image in moving)


READ = {
    "amplitude": (correlations, "plain"),
    "amplitude, whitened": (correlations, "white"),
    "complex": (coherences, "plain"),
    "complex, ramp out": (coherences, "ramp"),
    "complex, whitened": (coherences, "white"),
}
METHODS = ("intensity", *READ)


def read_at(rho, offset):
    """Value a fraction of a lag off the centre, by parabolas through the logarithm as in the package."""
    t = np.clip(offset, -1.0, 1.0).T
    lateral, axial = np.stack([t * (t - 1) / 2, 1 - t * t, t * (t + 1) / 2], axis=2)
    return np.exp(np.einsum("pi,pj,pij->p", lateral, axial, np.log(np.maximum(rho, 0.02))))


class Reader:
    """Prepares the frames of one sweep for every method and reads pairs of them."""

    def __init__(self, **settings):
        self.sweep = load_sweep(simulated(SimulationSettings(**{"vectors": VECTORS, **settings})))
        c = Config()
        self.matcher = FrameMatcher(self.sweep, c.intensity, c.patches, c.inplane, INTENSITY)
        self.patches, grid, signal = self.matcher.patches, self.matcher.grid, self.sweep.signal
        self.analytic = self.matcher.extractor.analytic
        self.per_mm = 4e-3 * np.pi * np.mean(signal.bandwidth_hz) / signal.speed_of_sound_m_s
        self.x_mm = np.arange(grid.vectors)[:, None] * grid.vector_pitch_mm
        self.y_mm = np.arange(grid.samples) * grid.sample_spacing_mm
        self.depth_mm, self.rows = np.unique(self.patches.centre_mm[:, 1], return_inverse=True)
        power = [np.abs(fft.fft(self.analytic(self.sweep.frames[n]))) ** 2 for n in range(0, 160, 10)]
        level = np.pad(np.mean(power, axis=(0, 1)), 7, mode="wrap")
        level = np.convolve(level, np.hanning(17)[1:-1] / 8, "valid")
        # What is much weaker than the spectrum's peak is not brought to its level, or noise would be.
        self.whitening = np.sqrt(level) / (level + 0.02 * level.max())

    def strained(self, analytic):
        """Echoes of tissue pressed by STRAIN towards the image's middle: moved, and turned in phase."""
        shift = STRAIN * (self.y_mm - self.y_mm.mean())
        moved = CubicSpline(self.y_mm, analytic, axis=1)(np.clip(self.y_mm - shift, 0, self.y_mm[-1]))
        return moved * np.exp(-1j * self.per_mm * shift)

    def prepare(self, number, strained=False):
        """One frame for the package's matching and for what reads each kind of echo, equalised."""
        analytic = self.analytic(self.sweep.frames[number])
        analytic = self.strained(analytic) if strained else analytic
        frame = {"ready": self.matcher.prepare(Echo((np.abs(analytic) ** 2).astype(np.float32), None))}
        for kind, gain in (("plain", 1.0), ("white", self.whitening)):
            echo = fft.ifft(fft.fft(analytic) * gain)
            power = (np.abs(echo) ** 2).astype(np.float32)
            amplitude = np.sqrt(self.matcher.extractor.equalise(power))
            echo *= amplitude / np.sqrt(np.maximum(power, 1e-30))
            frame[kind] = {"echo": echo, correlations: amplitude, coherences: parts(echo)}
        return {**frame, "ramp": frame["plain"]}

    def read(self, fixed, moving, start):
        """In-plane motion of a pair and its correlation by every method, each of shape (p,)."""
        match = self.matcher.match(fixed["ready"], moving["ready"], start)
        shift, slope = self._shift(fixed["ready"].image, moving["ready"].image, match.motion)
        lag = np.rint(shift / self.patches.spacing_mm).astype(np.int64)
        place, offset = (self.patches.first, self.patches.size, lag), shift / self.patches.spacing_mm - lag
        ramp = np.exp(1j * self.per_mm * (slope[0] * self.x_mm + slope[1] * self.y_mm))
        moving = {**moving, "ramp": {coherences: parts(moving["plain"]["echo"] * ramp)}}
        rho = {"intensity": match.correlation}
        for method, (how, kind) in READ.items():
            rho[method] = read_at(how(fixed[kind][how], moving[kind][how], *place), offset)
        return match.motion, rho

    def _shift(self, fixed, moving, motion):
        """Shift of each patch, mm, linear in its place as the package has it; slopes of the axial shift."""
        about = np.rint(-np.array([motion.x_mm, motion.y_mm]) / self.patches.spacing_mm).astype(np.int64)
        lag = np.tile(about, (len(self.patches), 1))
        rho = np.empty((len(lag), 3, 3))
        patch_correlations(fixed, moving, self.patches.first, self.patches.size, lag, 0.6, rho)
        shift, weight = inplane_twin.peaks(rho, lag, self.patches.spacing_mm)
        shift, weight = np.nan_to_num(shift), np.sqrt(weight)
        design = np.pad(self.matcher.at_mm, ((0, 0), (1, 0)), constant_values=1.0)
        for _ in range(4):
            plane = np.linalg.lstsq(design * weight[:, None], shift * weight[:, None], rcond=None)[0]
            left = np.abs(shift - design @ plane) / np.abs(shift - design @ plane)[weight > 0].mean(axis=0)
            weight[left.max(axis=1) > 4] = 0.0
        return design @ plane, plane[1:, 1]

    def cells(self, kind):
        """Independent cells in a patch of each row: its area over the integral of |autocorrelation|^2."""
        frames = np.stack([self.prepare(n)[kind]["echo"] for n in range(0, 160, 5)])
        size, found = self.patches.size, []
        for top in np.unique(self.patches.first[:, 1]):
            strip = frames[:, :, top : top + size[1]]
            full = np.array(strip.shape[1:])
            lag = np.abs((np.moveaxis(np.indices(2 * full), 0, -1) + full) % (2 * full) - full)
            sums = fft.ifft2((np.abs(fft.fft2(strip, 2 * full)) ** 2).mean(axis=0))
            gamma = np.abs(sums) / np.maximum(full - lag, 1).prod(axis=2)
            squared = gamma**2 * np.maximum(1 - lag / size, 0).prod(axis=2)
            found.append(size.prod() * squared[0, 0] / squared.sum())
        return np.array(found)

    def samples(self, apart, block, strained=False):
        """True distances and correlations by method, (n, p), of frames `apart` within blocks of frames."""
        distance, found, prepared = [], [], lru_cache(2 * COUNT)(self.prepare)
        for n, k in [(n, k) for n in range(len(self.sweep)) for k in apart if n % block + k < block]:
            one, two = prepared(n), prepared(n + k, strained)
            moved, rho = self.read(one, two, self.matcher.search(one["ready"], two["ready"]))
            at = np.pad(self.patches.centre_mm - [moved.x_mm, moved.y_mm], ((0, 0), (0, 1)))
            distance.append(np.abs((self.sweep.truth[n].inv() * self.sweep.truth[n + k]).apply(at)[:, 2]))
            found.append(rho)
        return np.array(distance), {m: np.array([rho[m] for rho in found]) for m in METHODS}

    def print_cost(self):
        """Time of matching a pair as the package does, and of what the complex correlation adds."""
        one, two = self.prepare(0), self.prepare(2)
        echo, others = one["plain"][coherences][0], two["plain"][coherences]
        place = self.patches.first * [2, 1], self.patches.size * [2, 1], 0 * self.patches.first
        runs = (
            lambda: self.matcher.match(one["ready"], two["ready"], InPlaneMotion()),
            lambda: [correlations(echo, image, *place) for image in others],
        )
        match, more = (1e3 * min(timeit.repeat(run, number=1, repeat=50)) for run in runs)
        print(f"\na pair: intensity {match:.2f} ms, complex {more:.2f} ms more, ratio {1 + more / match:.2f}")


def curves(folds, method, rows):
    """sqrt(-ln rho) of each row on GRID_MM: a cubic, for it is nearly straight, then its tangent."""
    distance, rho = (np.concatenate(x) for x in zip(*((d[:, 0], r[method]) for d, r in folds), strict=True))
    steps, which = np.unique(distance.round(3), return_inverse=True)
    found = []
    for row in range(rows.max() + 1):
        mean = np.array([np.nanmean(rho[which == k][:, rows == row]) for k in range(steps.size)])
        last = np.argmax(np.append(mean, 0.0) < REACH / 2)
        d, root = steps[:last], np.sqrt(-np.log(mean[:last]))
        fit = Polynomial.fit(d, root, 3, w=root * mean[:last] / (1 - mean[:last] ** 2))
        found.append(fit(np.minimum(GRID_MM, d[-1])) + fit.deriv()(d[-1]) * np.maximum(GRID_MM - d[-1], 0))
    return np.maximum.accumulate(found, axis=1)


def distances(root, rho, rows):
    """Distance of each patch, shape (n, p), by the curve of its row."""
    measured = np.sqrt(-np.log(np.clip(rho, 0.02, 1.0)))
    return np.stack([np.interp(measured[:, p], root[row], GRID_MM) for p, row in enumerate(rows)], axis=1)


def print_table(title, groups, least, reader):
    """Deviations and biases; `groups` holds samples and curves to read them with, `least` r and the bound."""
    d = np.concatenate([distance for (distance, _), _ in groups])
    r, sigma = (v[reader.rows, np.minimum(np.rint(d / GRID_MM[1]).astype(int), 400)] for v in least)
    rho = {m: np.concatenate([found[m] for (_, found), _ in groups]) for m in METHODS}
    found = {m: np.concatenate([distances(c[m], s[m], reader.rows) for (_, s), c in groups]) for m in METHODS}
    depth = reader.depth_mm[reader.rows]
    print(f"\n{title}")
    for name, (top, bottom) in DEPTHS_MM.items():
        seen = (depth >= top) & (depth < bottom) & (r**2 >= REACH)
        bins = [seen & (np.abs(d - k * STEP_MM) < 0.9 * STEP_MM) for k in TESTED_STEPS]
        bins = [b for b in bins if b.sum() > 100]
        ratios = [np.nanmean(rho["intensity"][b]) / np.nanmean(rho["complex"][b]) for b in bins]
        rows = {f"{name}: distance, mm": [f"{d[b].mean():.2f}" for b in bins]}
        rows["r; bound, um"] = [f"{r[b].mean():.2f}; {1e3 * sigma[b].mean():4.1f}" for b in bins]
        rows["rho_I / |rho_c|^2"] = [f"{ratio:.2f}" for ratio in ratios]
        for m in METHODS:
            error = [((found[m] - d)[b], sigma[b]) for b in bins]
            rows[m] = [f"{np.nanstd(e / s):.2f} ({1e3 * np.nanmean(e):+4.0f})" for e, s in error]
        for label, values in rows.items():
            print(f"  {label:22}" + "".join(f"{value:>14}" for value in values))


def main() -> None:
    readers = [Reader(**STEPPED, seed=seed) for seed in CURVE_SEEDS]
    cells = {kind: readers[0].cells(kind) for kind in ("plain", "white")}
    print("cells of a patch from top to bottom:", {kind: n.round().astype(int) for kind, n in cells.items()})
    stepped = [reader.samples(CURVE_STEPS, COUNT) for reader in readers]
    others = [stepped[:k] + stepped[k + 1 :] for k in range(3)]
    every, *folds = ({m: curves(fold, m, readers[0].rows) for m in METHODS} for fold in (stepped, *others))
    r = np.exp(-(every["complex"] ** 2) / 2)
    slope = np.maximum(-np.gradient(r, GRID_MM[1], axis=1), 1e-6)
    least = r, (1 - r**2) / np.sqrt(2 * cells["plain"][:, None]) / slope
    print_table("stepped phantom", list(zip(stepped, folds, strict=True)), least, readers[0])
    pressed = [(readers[0].samples(TESTED_STEPS, COUNT, strained=True), folds[0])]
    print_table(f"stepped, pressed by {100 * STRAIN:.1f} % between frames", pressed, least, readers[0])
    for preset in ("phantom", "tissue"):
        sweeps = [Reader(preset=preset, length_mm=20.0, seed=seed) for seed in HAND_SEEDS]
        groups = [(reader.samples((2, 3, 4), len(reader.sweep)), every) for reader in sweeps]
        print_table(f"{preset}, hand-held, pairs two to four frames apart", groups, least, readers[0])
    readers[0].print_cost()


if __name__ == "__main__":
    main()
