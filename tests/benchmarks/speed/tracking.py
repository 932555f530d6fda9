"""Tracking a sweep: frames per second beside the transforms alone, cores kept busy."""

from contextlib import nullcontext

import numpy as np
from scipy import fft

from speckle3d.core.threads import cores, on_one_thread
from speckle3d.io.load import load_sweep
from speckle3d.matching.intensity import IntensityExtractor
from speckle3d.tracking import track
from speed.rows import Row, time_runs

TARGETS = {1: 80.0, 2: 150.0}
FRAMES = 20


def rows(paths, curves, runs):
    """One row for each sweep on all cores, and for the first on one."""
    table = []
    for number, path in enumerate([paths[0], *paths]):
        alone = number == 0
        sweep, threads = load_sweep(path), 1 if alone else cores()
        with on_one_thread() if alone else nullcontext():
            ours = time_runs(lambda sweep=sweep: track(sweep, curves), runs)
        limit = transforms_per_second(sweep, runs)
        table.append(
            Row(
                f"track, {len(sweep)} frames of {sweep.grid.vectors} x {sweep.grid.samples}, "
                f"{threads} core{'s' * (threads > 1)}",
                len(sweep) / ours.seconds,
                "frames/s",
                "the transforms alone, 1 core",
                limit,
                TARGETS.get(threads),
                cores=ours.cores,
            )
        )
    return table


def transforms_per_second(sweep, runs):
    """Frames whose samples go to the band's spectrum and back in a second on one core, and nothing else."""
    plan = IntensityExtractor(sweep.signal, sweep.grid)._plan
    frame = np.asarray(sweep.frames[0], dtype=np.float32)
    band = np.zeros((frame.shape[0], plan.out_length), dtype=np.complex64)

    def transforms():
        for _ in range(FRAMES):
            fft.rfft(frame, plan.length, axis=1)
            fft.ifft(band, axis=1)

    return FRAMES / time_runs(transforms, runs).seconds
