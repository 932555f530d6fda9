"""Simulated sweeps for the benchmarks, kept by what determines them: their settings and the simulator."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import speckle3d
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.io.load import load_sweep
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.simulation.presets import simulate

DEFAULT = Path(__file__).resolve().parents[2] / ".cache" / "sweeps"
_SIMULATOR = ("simulation/*.py", "kernels/scatter.py", "kernels/diffraction.py", "core/geometry.py")


def simulated(settings, folder=DEFAULT):
    """The sweep of `settings` as a file, simulated once; streamed, so that its size does not matter."""
    path = folder / f"{settings.preset}-{settings.seed}-{key_of(settings.model_dump_json())}.h5"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_sweep(path, simulate(settings)[0].sweep)
    return path


def simulated_pair(settings, folder=DEFAULT):
    """The two sweeps of a ``crossed`` preset as files."""
    stem = f"{settings.preset}-{settings.seed}-{key_of(settings.model_dump_json())}"
    paths = folder / f"{stem}.h5", folder / f"{stem}-crossing.h5"
    if not all(path.is_file() for path in paths):
        folder.mkdir(parents=True, exist_ok=True)
        for path, made in zip(paths, simulate(settings), strict=True):
            write_sweep(path, made.sweep)
    return paths


def to_and_fro(source, frames, folder=DEFAULT):
    """A long sweep made of a short one run forward and back, so that neighbours always share speckle."""
    path = folder / f"{source.stem}-{frames}.h5"
    if path.is_file():
        return path
    sweep = load_sweep(source)
    there = np.arange(len(sweep))
    index = np.resize(np.concatenate([there, there[-2:0:-1]]), frames)
    tracker, orientation = _sensors(sweep, index)
    long = replace(
        sweep,
        frames=_InOrder(sweep.frames, index),
        frame_time_s=0.04 * np.arange(frames),
        truth=sweep.truth[index],
        tracker=tracker,
        orientation=orientation,
        path=None,
    )
    write_sweep(path, long)
    return path


class _InOrder:
    """Frames of a sweep, in another order."""

    any_thread = False

    def __init__(self, frames, index):
        self._frames, self._index = frames, index
        self.shape, self.dtype = (index.size, *frames.shape[1:]), frames.dtype

    def __len__(self):
        return self.shape[0]

    def __getitem__(self, number):
        return self._frames[int(self._index[number])]


def _sensors(sweep, index):
    """Exact sensors, fixed to the image, that read once per frame."""
    time_s = 0.04 * np.arange(index.size)
    poses = sweep.truth[index]
    one = poses[0].inv() * poses[0]
    return (
        Tracker(TimedPoses(time_s, poses), one),
        OrientationSensor(TimedRotations(time_s, poses.rotation), Rotation.identity()),
    )


def key_of(settings):
    """Digest of some settings and of the simulator."""
    package = Path(speckle3d.__file__).parent
    digest = hashlib.sha256(settings.encode())
    for pattern in _SIMULATOR:
        for source in sorted(package.glob(pattern)):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
