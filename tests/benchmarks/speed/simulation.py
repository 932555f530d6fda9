"""Simulated frames per second, on all cores beside one."""

from contextlib import nullcontext

from speckle3d.core.threads import ahead, cores, on_one_thread
from speckle3d.simulation.presets import simulate
from speckle3d.simulation.settings import SimulationSettings
from speed.rows import Row, timed

FRAMES = 24


def rows(runs):
    """One row for a phantom, one for tissue."""
    return [_row(preset, min(runs, 3)) for preset in ("phantom", "tissue")]


def _row(preset, runs):
    settings = SimulationSettings(preset=preset, seed=2001, length_mm=7.5, frames=60)
    frames = simulate(settings)[0].sweep.frames

    def made(alone):
        def some():
            with on_one_thread() if alone else nullcontext():
                list(ahead(frames.__getitem__, range(FRAMES)))

        return timed(some, runs)

    ours, one = made(False), made(True)
    what = f"simulate, {preset}, {settings.vectors} vectors, {cores()} cores"
    return Row(what, FRAMES / ours.seconds, "frames/s", "one core", FRAMES / one.seconds, cores=ours.cores)
