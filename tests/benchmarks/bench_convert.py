"""Speed of writing sweep files, beside a plain loop over h5py's gzip of the same frames in the same process.

Run: ``python tests/benchmarks/bench_convert.py [--gigabytes 1]``. Frames are those of ``data/phantom.h5``
over and over, as int16 RF and as I/Q; the source has no compression and is read as fast as the disk gives.
Every write ends with the file on the disk (fsync). The peak is resident memory of ``speckle3d convert``.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from speckle3d.core.sweep import Sweep
from speckle3d.io.load import load_sweep
from speckle3d.io.sweep_writer import COMPRESSIONS, write_sweep
from speckle3d.simulation.receiver import received_as_iq

SOURCE = Path(__file__).resolve().parents[2] / "data" / "phantom.h5"
TARGET_MB_S, MB = 200.0, 1e6


class Repeated:
    """Some frames in memory, over and over."""

    def __init__(self, frames: list[np.ndarray], count: int, stored: np.dtype) -> None:
        self._frames, self.stored_dtype = frames, stored
        self.shape, self.dtype = (count, *frames[0].shape), frames[0].dtype

    def __getitem__(self, index: int) -> np.ndarray:
        return self._frames[range(self.shape[0])[index] % len(self._frames)]


def long_sweep(sweep: Sweep, size_bytes: float) -> Sweep:
    """A sweep of so many bytes on the disk."""
    frames = [sweep.frames[i] for i in range(24)]
    stored = np.dtype(getattr(sweep.frames, "stored_dtype", sweep.frames.dtype))
    sample_bytes = stored.itemsize * (2 if np.iscomplexobj(frames[0]) and stored.kind == "i" else 1)
    count = round(size_bytes / (frames[0].size * sample_bytes))
    held = Repeated(frames, count, stored)
    return replace(sweep, frames=held, frame_time_s=np.arange(count) / 25, orientation=None, tracker=None,
                   truth=None)  # fmt: skip


def seconds(write: Callable[[], object], path: Path) -> float:
    """Until what was written is on the disk."""
    began = time.perf_counter()
    write()
    with open(path, "rb") as file:
        os.fsync(file.fileno())
    return time.perf_counter() - began


def plain_gzip(source: Path, path: Path) -> None:
    """What one writes without this package."""
    with h5py.File(source) as old, h5py.File(path, "w") as new:
        (name,) = (each for each in ("rf", "iq") if each in old)
        node = old[name]
        made = new.create_dataset(
            name, node.shape, node.dtype, chunks=(1, *node.shape[1:]), compression="gzip", shuffle=True
        )
        for i in range(node.shape[0]):
            made[i] = node[i]


def disk_speed(path: Path, size_bytes: float) -> float:
    """MB/s of writing bytes in pieces of 1 MB, fsync included."""
    piece = np.random.default_rng(0).bytes(2**20)

    def write() -> None:
        with open(path, "wb", buffering=0) as file:
            for _ in range(round(size_bytes / 2**20)):
                file.write(piece)

    return size_bytes / MB / seconds(write, path)


def report(name: str, sweep: Sweep, size_bytes: float, folder: Path) -> Path:
    """Print each way's speed and file size; return the uncompressed file."""
    source, out = folder / f"{name}.h5", folder / "out.h5"
    write_sweep(source, long_sweep(sweep, size_bytes), compression=None)
    size = source.stat().st_size
    took = seconds(lambda: plain_gzip(source, out), out)
    alone = out.stat().st_size
    print(f"{name}: {size / MB:.0f} MB in {len(load_sweep(source))} frames")
    print(f"  {'h5py, gzip in a loop':34}{size / MB / took:7.0f} MB/s  {alone / size:.2f} of the size")
    for word, compression in COMPRESSIONS.items():
        before = time.process_time()
        spent = seconds(lambda packing=compression: write_sweep(out, load_sweep(source), None, packing), out)
        worked = time.process_time() - before
        speed, share = size / MB / spent, out.stat().st_size / size
        missed = "!" if word == "none" and speed < TARGET_MB_S else ""
        times = f"{took / spent:.1f} x{missed}, {1e3 * worked / (size / MB):.1f} s of processors a GB"
        print(f"  {'read, written, ' + word:34}{speed:7.0f} MB/s  {share:.2f} of the size, {times}")
        began = time.perf_counter()
        again = load_sweep(out)
        for i in range(len(again)):
            again.frames[i]
        print(f"  {'read again':34}{size / MB / (time.perf_counter() - began):7.0f} MB/s")
    out.unlink()
    return source


def peak_mb(source: Path, out: Path) -> float:
    """Largest resident memory of the command on a file."""
    command = [sys.executable, "-m", "speckle3d.cli", "convert", str(source), str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, command
    return usage.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gigabytes", type=float, default=1.0)
    parser.add_argument("--folder", type=Path, help="where to write, by default a temporary place")
    options = parser.parse_args()
    size_bytes = options.gigabytes * 1e9
    with tempfile.TemporaryDirectory(dir=options.folder) as made:
        folder = Path(made)
        print(f"{os.cpu_count()} cores; disk {disk_speed(folder / 'raw', size_bytes):.0f} MB/s")
        (folder / "raw").unlink()
        sweep = load_sweep(SOURCE)
        rf = report("rf", sweep, size_bytes, folder)
        report("iq", received_as_iq(sweep), size_bytes / 4, folder)
        for part in (rf, report("a quarter of it", sweep, size_bytes / 4, folder)):
            peak = peak_mb(part, folder / "out.h5")
            print(f"peak of `speckle3d convert` on {part.stat().st_size / MB:.0f} MB: {peak:.0f} MB")


if __name__ == "__main__":
    main()
