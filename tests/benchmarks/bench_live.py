"""Delay from a frame's message to its pose's, as the scanner's side sees it, beside recording and the volume.

python tests/benchmarks/bench_live.py SWEEP CURVES [--seconds 20] [--no-volume]

The sweep (RF) is played over the loopback at its own rate, to and fro so that it can go on.
"""

import argparse
import tempfile
import threading
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from options import parsed

import speckle3d as s3
from speckle3d.io.igtl.link import Connection, Server
from speckle3d.io.igtl.messages import TransformReceived, packed_image
from speckle3d.io.import_settings import ImportSettings
from speckle3d.live.session import Session, SessionSettings
from speckle3d.live.warming import warm_up


def play(path, seconds, told):
    """Send frames when they are due; tell the delays of the poses that came back, and the frames sent."""
    sweep = s3.load_sweep(path)
    there = list(range(len(sweep)))
    frames = [np.asarray(sweep.frames[k]).T for k in there]
    order = (there + there[-2:0:-1]) * 1000
    interval_s = float(np.median(np.diff(sweep.frame_time_s)))
    sent, delays = {}, []
    with Server(0) as server:
        told.put(server.port)
        server.wait_connected(60.0)

        def listen():
            while not over.is_set():
                found, now = server.receive(0.05), time.monotonic()
                poses = (each for each in found if isinstance(each, TransformReceived))
                delays.extend(now - sent[round(each.time_s / interval_s)] for each in poses)

        over = threading.Event()
        listening = threading.Thread(target=listen)
        listening.start()
        begin, count = time.monotonic(), int(seconds / interval_s)
        for k in range(count):
            message = packed_image("Image", (k + 1) * interval_s, frames[order[k]], np.eye(4))
            time.sleep(max(0.0, begin + k * interval_s - time.monotonic()))
            sent[k + 1] = time.monotonic()
            server.send(message)
        time.sleep(2.0)
        over.set()
        listening.join()
    told.put((count, delays))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweep", type=Path)
    parser.add_argument("curves", type=Path)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--no-volume", action="store_true")
    options = parsed(parser, seconds=5.0)
    curves, sweep = s3.load_curves(options.curves), s3.load_sweep(options.sweep)
    signal = sweep.signal
    imported = ImportSettings(
        sampling_rate_hz=signal.sampling_rate_hz,
        vector_pitch_mm=sweep.grid.vector_pitch_mm,
        speed_of_sound_m_s=signal.speed_of_sound_m_s,
        centre_frequency_hz=signal.centre_frequency_hz,
        bandwidth_hz=signal.bandwidth_hz,
    )
    warm_up(curves, s3.Config())
    context = get_context("spawn")
    told = context.Queue()
    playing = context.Process(target=play, args=(options.sweep, options.seconds, told))
    playing.start()
    with tempfile.TemporaryDirectory() as folder, Connection("127.0.0.1", told.get()) as connection:
        settings = SessionSettings(
            Path(folder) / "sweep.h5", imported=imported, volume=not options.no_volume, check=True
        )
        session = Session(connection, [connection.send], curves, settings)
        session.run(options.seconds + 3.0)
        count, delays = told.get()
        kept = len(s3.load_sweep(settings.recording))
    playing.join()
    middle, late, last = 1e3 * np.quantile(delays, [0.5, 0.95, 1.0])
    grid = sweep.grid
    print(f"{grid.vectors} x {grid.samples}: {count} frames sent, {kept} recorded, {len(delays)} placed")
    print(f"delay of poses, ms: median {middle:.0f}, 95 % {late:.0f}, largest {last:.0f}")


if __name__ == "__main__":
    main()
