"""Delay from a frame's message to its pose's, as the scanner's side sees it, beside recording and the volume.

Run: ``python tests/benchmarks/bench_live.py [SWEEP CURVES] [--seconds 20]``. The sweep (RF) is played over
the loopback at its own rate, to and fro so that it can go on.
"""

import tempfile
import threading
import time
from multiprocessing import get_context
from pathlib import Path

import bench
import numpy as np

import speckle3d as s3
from speckle3d.io.igtl.link import Connection, Server
from speckle3d.io.igtl.messages import TransformReceived, packed_image
from speckle3d.io.import_settings import ImportSettings
from speckle3d.live.session import Session, SessionSettings
from speckle3d.live.warming import warm_up


def play(path, seconds, answers):
    """Send frames when they are due; answer with how many, and the delays of poses that came back."""
    sweep = s3.load_sweep(path)
    ahead = [np.asarray(sweep.frames[k]).T for k in range(len(sweep))]
    order = ahead + ahead[-2:0:-1]
    interval_s = float(np.median(np.diff(sweep.frame_time_s)))
    send_time_s, delays, over = {}, [], threading.Event()
    with Server(0) as server:
        answers.put(server.port)
        while not server.peers:
            time.sleep(0.005)

        def listen():
            while not over.is_set():
                messages, time_s = server.receive(0.05), time.monotonic()
                poses = (m for m in messages if isinstance(m, TransformReceived))
                delays.extend(time_s - send_time_s[round(m.time_s / interval_s)] for m in poses)

        listening = threading.Thread(target=listen)
        listening.start()
        begin, count = time.monotonic(), int(seconds / interval_s)
        for k in range(count):
            message = packed_image("Image", (k + 1) * interval_s, order[k % len(order)], np.eye(4))
            time.sleep(max(0.0, begin + k * interval_s - time.monotonic()))
            send_time_s[k + 1] = time.monotonic()
            server.send(message)
        time.sleep(2.0)
        over.set()
        listening.join()
    answers.put((count, delays))


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("sweep", type=Path, nargs="?", default=bench.DATA / "phantom.h5")
    parser.add_argument("curves", type=Path, nargs="?", default=bench.DATA / "curves.h5")
    parser.add_argument("--seconds", type=float, default=20.0)
    options = bench.parse_options(parser, seconds=2.0)
    curves, sweep = s3.load_curves(options.curves), s3.load_sweep(options.sweep)
    signal = {
        name: getattr(sweep.signal, name)
        for name in vars(sweep.signal)
        if name in ImportSettings.model_fields
    }
    geometry = ImportSettings(vector_pitch_mm=sweep.grid.vector_pitch_mm, **signal)
    warm_up(curves, s3.Config())
    context = get_context("spawn")
    answers = context.Queue()
    playing = context.Process(target=play, args=(options.sweep, options.seconds, answers))
    playing.start()
    with tempfile.TemporaryDirectory() as folder, Connection("127.0.0.1", answers.get()) as connection:
        settings = SessionSettings(Path(folder) / "sweep.h5", importing=geometry, volume=True, check=True)
        Session(connection, [connection.send], curves, settings).run(options.seconds + 3.0)
        count, delays = answers.get()
        length = len(s3.load_sweep(settings.recording))
    playing.join()
    middle, late, last = 1e3 * np.quantile(delays, [0.5, 0.95, 1.0])
    grid = sweep.grid
    print(f"{grid.vectors} x {grid.samples}: {count} frames sent, {length} recorded, {len(delays)} placed")
    print(f"delay of poses, ms: median {middle:.0f}, 95 % {late:.0f}, largest {last:.0f}")


if __name__ == "__main__":
    main()
