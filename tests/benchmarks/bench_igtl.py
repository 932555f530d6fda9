"""Frames served, received and recorded over the loopback: what is lost, and its cost.

Run: ``python tests/benchmarks/bench_igtl.py [SECONDS]`` (60; 600 for the README's figure). For RF of 127 x
3818 samples and B-mode of 640 x 480 pixels, each at 25 frames/s: `speckle3d play` in a process of its own,
received by a `Connection` and recorded by a `GrowingSweep` here. Every frame carries its number. Printed are
frames received and recorded, the time from due to recorded, and this process's share of a core. Of killed
recorders: bench_growing.py.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from commands import command
from sweep_examples import RF

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.io.igtl.link import Connection
from speckle3d.io.igtl.messages import ImageReceived
from speckle3d.io.load import load_sweep
from speckle3d.io.sweep_writer import GrowingSweep, write_sweep

RATE_HZ, FRAMES = 25.0, 50


def example(kind):
    """A sweep whose frames carry their numbers in their first samples."""
    rng = np.random.default_rng(0)
    if kind == "rf":
        frames = rng.normal(0, 300, (FRAMES, 127, 3818)).astype(np.int16)
        grid, signal = ImageGrid(127, 3818, 0.3, RF.sample_spacing_mm), RF
    else:
        frames = rng.integers(0, 256, (FRAMES, 640, 480)).astype(np.uint8)
        grid, signal = ImageGrid(640, 480, 0.1, 0.1), BModeSettings(60.0)
    frames[:, 0, 0] = np.arange(FRAMES)
    return Sweep(frames, grid, signal, np.arange(FRAMES) / RATE_HZ)


def played(path, port):
    """Start a server; its process and its port."""
    process = subprocess.Popen(
        command("play", path, "--loop", "--port", port), stderr=subprocess.PIPE, text=True
    )
    while "waiting" not in (said := process.stderr.readline()):
        if not said:
            raise RuntimeError("the server has ended")
    return process, int(said.split(":")[1])


def recorded(path, sweep, port, seconds):
    """Receive and record; returns numbers of the frames, delays, and the connection's state."""
    numbers, delays = [], []
    end = time.monotonic() + seconds
    with (
        Connection("127.0.0.1", port) as connection,
        GrowingSweep(path, sweep.grid, sweep.signal, sweep.frames.dtype) as growing,
    ):
        while time.monotonic() < end:
            for each in connection.receive(0.1):
                if not isinstance(each, ImageReceived):
                    continue
                frame = each.pixels.T if sweep.signal is RF else each.pixels
                growing.append(frame, each.time_s)
                numbers.append(int(frame[0, 0]))
                delays.append(time.monotonic() - each.time_s)
        return numbers, delays, connection.state


def lost(numbers):
    """Frames missing between others."""
    return int(((np.diff(numbers) - 1) % FRAMES).sum())


def measure(kind, seconds, folder):
    sweep = example(kind)
    write_sweep(folder / f"{kind}.h5", sweep, compression=None)
    server, port = played(folder / f"{kind}.h5", 0)
    busy = time.process_time()
    numbers, delays, state = recorded(folder / "recorded.h5", sweep, port, seconds)
    busy = (time.process_time() - busy) / seconds
    server.terminate()
    server.communicate()
    found = load_sweep(folder / "recorded.h5")
    same = all(int(found.frames[i][0, 0]) == number for i, number in enumerate(numbers))
    late = 1e3 * (np.array(delays) - min(delays))
    print(
        f"{kind}, {seconds:g} s: {len(numbers)} frames received, {len(found)} recorded "
        f"({'all the same' if same else 'OTHERS'}), {lost(numbers)} lost, {state.refused} refused; later "
        f"than the earliest one: median {np.median(late):.1f} ms, 99 % {np.percentile(late, 99):.1f} ms, "
        f"most {late.max():.1f} ms; {busy:.2f} of a core"
    )
    found.frames.close()
    (folder / "recorded.h5").unlink()
    return lost(numbers) + (not same)


def main(seconds=60.0):
    """Run all; returns how much was lost."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return sum(measure(kind, seconds, folder) for kind in ("rf", "bmode"))


if __name__ == "__main__":
    sys.exit(main(*map(float, sys.argv[1:])))
