"""Simulated sweeps for the benchmarks, kept by what determines them: their settings and the simulator."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

import speckle3d
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.io.family.sweep_writer import write_sweep
from speckle3d.io.load import load_sweep
from speckle3d.simulation.presets import simulate

DEFAULT = Path(__file__).resolve().parents[2] / ".cache" / "sweeps"
_SIMULATOR = ("simulation/*.py", "kernels/scatter.py", "kernels/diffraction.py", "core/geometry.py")


def sweep_file(settings, folder=DEFAULT, number=0):
    """Sweep `number` of `settings` as a file, simulated once; streamed, so that its size does not matter."""
    stem = f"{settings.preset}-{settings.seed}-{key_of(settings.model_dump_json())}"
    return ensure_file(folder / f"{stem}{number * '-crossing'}.h5", lambda: simulate(settings)[number].sweep)


def ensure_file(path, make):
    """The path at which the sweep that `make` returns is, written if it was not."""
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_sweep(path, make())
    return path


def to_and_fro(source, frames):
    """A long sweep made of a short one run forward and back, with exact sensors that read once per frame."""

    def long():
        sweep = load_sweep(source)
        ahead = np.arange(len(sweep))
        index = np.resize(np.concatenate([ahead, ahead[-2:0:-1]]), frames)
        time_s, poses = 0.04 * np.arange(frames), sweep.truth[index]
        return replace(
            sweep,
            frames=_InOrder(sweep.frames, index),
            frame_time_s=time_s,
            truth=poses,
            tracker=Tracker(TimedPoses(time_s, poses), RigidTransform.identity()),
            orientation=OrientationSensor(TimedRotations(time_s, poses.rotation), Rotation.identity()),
            path=None,
        )

    return ensure_file(DEFAULT / f"{source.stem}-{frames}.h5", long)


class _InOrder:
    """Frames of a sweep, in another order."""

    any_thread = False

    def __init__(self, frames, index):
        self._frames, self._index = frames, index
        self.shape, self.dtype = (index.size, *frames.shape[1:]), frames.dtype

    def __getitem__(self, number):
        return self._frames[int(self._index[number])]


def key_of(settings):
    """Digest of some settings and of the simulator."""
    package = Path(speckle3d.__file__).parent
    digest = hashlib.sha256(settings.encode())
    for pattern in _SIMULATOR:
        for source in sorted(package.glob(pattern)):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:12]
