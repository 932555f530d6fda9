"""How sure, and is that so: distances, spheres and a helix against what is known of them.

Run: ``python tests/benchmarks/bench_surfaces.py [--first-seed N] [--count 24] [--workers 2]``.

First the digital phantom at known poses: spheres and a helix, cut by formula along a curved freehand path and
compounded in three ways. Then simulated sweeps of every kind, each reconstructed once and kept: how often two
points picked in different frames are as far apart as claimed (68 % and 95 % of them should be), by mode. Rows
of one sweep are wrong together, so that the shares say less than their number suggests; the median over
sweeps of each one's own root mean square, in claimed deviations, stands beside them.
"""

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import numpy as np
from cache import DEFAULT, key_of, simulated

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from digital_phantom import INSIDE, LEVEL, OUTSIDE, Ball, Helix, Phantom, curved_path

import speckle3d
from speckle3d.config import Config
from speckle3d.core.errors import Speckle3DError
from speckle3d.core.pose_errors import Belonging
from speckle3d.core.reconstruction import Provenance, Reconstruction
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.core.volume import Volume
from speckle3d.corrections import correct
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.measures.measure import measured
from speckle3d.imaging.measures.surface import surface_of
from speckle3d.imaging.voxels.grid import grid_around
from speckle3d.imaging.voxels.volume import compound, look_up_voxels
from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import ReconstructionWriter, read_reconstruction
from speckle3d.pipeline import track
from speckle3d.simulation.settings import SimulationSettings
from speckle3d.study.details import trust_of
from speckle3d.study.pose_errors import posed_errors_of

FIRST_SEED = 41001
MODES = ("orientation", "pose", "fused")
_ESTIMATORS = ("matching", "motion", "correction")
STEP_MM = 0.25
PAIRS, LEAST_APART_MM = 60, 1.0
PRESETS = ("phantom", "tissue", "reversal", "rotation")
CURVES = Path(__file__).resolve().parents[2] / "data" / "curves.h5"


@dataclass(frozen=True)
class Found:
    """One quantity against the truth: its error and its claimed deviation."""

    sweep: str
    mode: str
    what: str
    error: float
    sigma: float


def at_known_poses() -> None:
    """Print sizes of spheres and a helix from volumes made at known poses."""
    balls = [
        Ball((5.0, 6.0, 6.0), 3.0),
        Ball((14.0, 7.0, 7.0), 4.0),
        Ball((6.0, 16.0, 9.0), 5.0),
        Ball((15.0, 17.0, 18.0), 2.0),
    ]
    helix = Helix((10.0, 12.0, 34.0), 4.0, 4.0, 2.5, 0.9)
    phantom = Phantom((*balls, helix), ImageGrid(200, 230, 0.1, 0.1))
    poses = curved_path(480, 46.0)
    images, grid = phantom.images(poses), phantom.grid
    voxel_grid = grid_around(grid, poses, STEP_MM)
    print(f"known poses; voxels of {STEP_MM} mm, images 0.1 mm apart with pixels of 0.1 mm")
    print(f"{'':16}{'radius':>9}{'volume, % of voxels':>21}{'of mesh':>9}{'vertices off, voxels':>22}  rms")
    for way in ("nearest, mean", "linear, mean", "backward"):
        volume = _volume(way, images, grid, poses, voxel_grid)
        surface = surface_of(volume, LEVEL)
        part, middles = surface.parts(), surface.vertices_mm[surface.triangles].mean(axis=1)
        for body in (*balls, helix):
            own = surface.of_triangles(part == part[np.abs(body.depth(middles)).argmin()])
            away = np.abs(body.depth(own.vertices_mm)) / STEP_MM
            size = f"{away.max():22.2f}{np.sqrt((away**2).mean()):5.2f}"
            if isinstance(body, Helix):
                print(f"{way:16}{'helix':>9}{'':30}{size}")
                continue
            sizes = [_voxel_volume(volume, body), own.volume_mm3]
            of_voxels, of_mesh = (100 * (size / body.volume_mm3 - 1) for size in sizes)
            print(f"{way:16}{body.radius_mm:6.1f} mm{of_voxels:+21.2f}{of_mesh:+9.2f}{size}")


def _volume(way: str, images, grid: ImageGrid, poses, voxel_grid) -> Volume:
    if way != "backward":
        return compound(images, grid, poses, voxel_grid=voxel_grid, splat=way.split(",")[0])
    voxels, _ = look_up_voxels(PosedImages(images, grid, poses), voxel_grid, 0.5)
    return Volume(voxels.T, voxel_grid.spacing_mm, voxel_grid.world_from_grid)


def _voxel_volume(volume: Volume, ball: Ball) -> float:
    """Volume of a sphere by its voxels' grey levels, each counted by its share of the inside."""
    index = np.moveaxis(np.indices(volume.shape), 0, -1)
    near = ball.depth(volume.world_from_grid.apply(index.reshape(-1, 3) * volume.spacing_mm)) > -3 * STEP_MM
    share = (volume.voxels.reshape(-1)[near] - OUTSIDE) / (INSIDE - OUTSIDE)
    return float(np.nansum(share) * np.prod(volume.spacing_mm))


def reconstructed(number: int, first_seed: int, folder: Path) -> Path | None:
    """Reconstruction of a sweep in all modes it has, made once; None if it is refused."""
    length_mm = float(np.random.default_rng(first_seed + number).uniform(4.0, 16.0))
    settings = SimulationSettings(
        preset=PRESETS[number % 4], seed=first_seed + number, vectors=32, samples=1500, length_mm=length_mm
    )
    source = simulated(settings, folder)
    package = Path(speckle3d.__file__).parent
    files = [path for room in _ESTIMATORS for path in sorted((package / room).rglob("*.py"))]
    text = "".join(path.read_text(encoding="utf-8") for path in files if path.stem != "joint_errors")
    path = folder / f"{source.stem}-{key_of(text)[:8]}-poses.h5"
    if path.is_file():
        return path
    sweep = load_sweep(source)
    shown, corrections = replace(sweep, truth=None), {}
    try:
        tracked = track(shown, read_curves(CURVES))
    except Speckle3DError:
        return None
    for mode in MODES:
        try:
            corrections |= correct(tracked, shown, [mode])
        except Speckle3DError:
            continue
    poses = {"image": tracked.image} | {mode: each.poses for mode, each in corrections.items()}
    with ReconstructionWriter(path, sweep.frame_time_s, sweep.grid) as writer:
        made = Provenance(str(source), "", "")
        writer.finish(poses, made, Config().to_toml(), trust_of(tracked, corrections))
    return path


def judged(number: int, first_seed: int, folder: Path) -> list[Found]:
    """Everything that is measured in one sweep."""
    path = reconstructed(number, first_seed, folder)
    if path is None:
        return []
    held = read_reconstruction(path)
    sweep = load_sweep(Path(held.provenance.input_path))
    found = []
    for mode in held.poses:
        found += distances(sweep, held, mode, np.random.default_rng(number))
    return found


def distances(sweep: Sweep, held: Reconstruction, mode: str, rng: np.random.Generator) -> list[Found]:
    """Distances between points of two frames each, half of them the same point of the image."""
    errors, found = posed_errors_of(held, mode), []
    grid, none = sweep.grid, np.zeros(2)
    for _ in range(PAIRS):
        frames = np.sort(rng.choice(len(sweep), 2, replace=False))
        points = np.zeros((2, 3))
        points[:, 0] = rng.uniform(0.0, grid.width_mm, 2)
        points[:, 1] = rng.uniform(grid.first_sample_depth_mm, grid.depth_mm, 2)
        same = rng.random() < 0.5
        points[1] = points[0] if same else points[1]
        true, own = (_at(poses, frames, points) for poses in (sweep.truth, held.poses[mode]))
        apart = float(np.linalg.norm(true[1] - true[0]))
        if apart < LEAST_APART_MM:
            continue
        belonging = Belonging(np.column_stack([frames, frames]), np.tile([1.0, 0.0], (2, 1)), none)
        (row,) = measured(own, belonging, errors, 0.0)
        what = "distance along" if same else "distance across"
        found.append(Found(sweep.name, mode, what, row.value - apart, row.pose_sigma))
    return found


def _at(poses, frames, points):
    return np.array([poses[int(frame)].apply(point) for frame, point in zip(frames, points, strict=True)])


def report(rows: list[Found]) -> None:
    """Print shares by mode and quantity."""
    heads = "".join(f"{word:>9}" for word in ("rows", "sweeps", "68 %", "95 %", "median", "error", "claimed"))
    print(f"\n{'mode':12} {'what':20}{heads}")
    for mode in dict.fromkeys(row.mode for row in rows):
        for what in dict.fromkeys(row.what for row in rows):
            mine = [row for row in rows if (row.mode, row.what) == (mode, what)]
            if not mine:
                continue
            error, sigma = np.array([(row.error, row.sigma) for row in mine]).T
            z, names = error / sigma, np.array([row.sweep for row in mine])
            own = [np.sqrt(np.mean(z[names == name] ** 2)) for name in np.unique(names)]
            shares = [100 * np.mean(np.abs(z) < most) for most in (1.0, 1.959964)]
            head = f"{mode:12} {what:20}{len(mine):9}{len(own):9}{shares[0]:9.0f}{shares[1]:9.0f}"
            size = f"{np.median(own):9.2f}{np.sqrt(np.mean(error**2)):9.3f}{np.median(sigma):9.3f}"
            print(head + size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--workers", type=int, default=2, help="sweeps at a time, a process each")
    parser.add_argument("--cache", type=Path, default=DEFAULT)
    options = parser.parse_args()
    at_known_poses()
    rows: list[Found] = []
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        waiting = [pool.submit(judged, n, options.first_seed, options.cache) for n in range(options.count)]
        for future in waiting:
            rows += future.result()
    report(rows)


if __name__ == "__main__":
    main()
