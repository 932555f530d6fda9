"""Calibrations and the orientation sensor: lines of a plane, two sweeps, logs, the filter of recordings."""

import tempfile
from pathlib import Path

import numpy as np
from bench_image_calibration import TRUTH, prepare_pair
from calibration_examples import scan_plane
from crossing_scenes import displace
from imu_logs import calibration, mt9_bin, mtdata2_messages, samples
from vqf import VQF, offlineVQF

from calibration.images.solver import calibrate_images
from calibration.plane import calibrate_plane
from calibration.settings import ImageFit
from speed.rows import Row, time_runs
from xsens.fusion.orient import Method, orient
from xsens.logs.read import read_log
from xsens.logs.samples import ImuLog

LINES = 700
RATE_HZ, READ_S, FILTER_S = 256.0, 3600.0, 600.0
PLANE_MS, IMAGES_S, READ_MB_S, FILTER_HZ = 50.0, 3.0, 50.0, 250e3


LOGS = {
    "MT9 .bin": lambda s: mt9_bin(s, calibration()),
    "MTData2 .mtb": lambda s: b"".join(mtdata2_messages(s, ticks=39)),
}


def plane(runs):
    """All of a plane's calibration."""
    lines = scan_plane(np.random.default_rng(0), LINES, line_noise_mm=0.2).lines
    whole = time_runs(lambda: calibrate_plane(lines), runs)
    label = f"calibrate_plane, {LINES} lines"
    return [Row(label, 1e3 * whole.seconds, "ms", target=PLANE_MS, falling=True, cores=whole.cores)]


def images(runs):
    """A calibration from two crossing sweeps, 20 mm and 20 degrees off at most."""
    crossing, start = prepare_pair(601), displace(TRUTH, np.random.default_rng(183))
    timing = time_runs(lambda: calibrate_images(crossing, start, ImageFit()), runs)
    label = "calibration from two sweeps, 160 frames each"
    return [Row(label, timing.seconds, "s", target=IMAGES_S, falling=True, cores=timing.cores)]


def logs(runs):
    """Megabytes per second of each kind of log."""
    readings = samples(int(RATE_HZ * READ_S), RATE_HZ)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "log")
        for kind, write in LOGS.items():
            path.write_bytes(write(readings))
            size = path.stat().st_size / 1e6
            seconds = time_runs(lambda: read_log(path), runs).seconds
            rows.append(Row(f"read {kind}, {size:.0f} MB", size / seconds, "MB/s", target=READ_MB_S))
    return rows


def filtering(runs):
    """Orientation of a recording by every method, beside VQF alone, on line or off line as the method is."""
    readings = samples(int(RATE_HZ * FILTER_S), RATE_HZ)
    vectors = [readings[name] for name in ("gyroscope_rad_s", "accelerometer_m_s2", "magnetometer_au")]
    log = ImuLog(readings["time_s"], vectors[1], vectors[0], vectors[2])

    peers = {
        False: ("VQF on line", lambda: VQF(1.0 / RATE_HZ).updateBatch(*vectors)),
        True: ("VQF off line", lambda: offlineVQF(*vectors, 1.0 / RATE_HZ)),
    }
    rows = []
    for method in Method:
        ours = time_runs(lambda method=method: orient(log, method=method), runs).seconds
        peer, run = peers[method.offline]
        rates = (len(log) / ours, "samples/s", peer, len(log) / time_runs(run, runs).seconds)
        rows.append(Row(f"orientation {method}, {RATE_HZ:g} Hz", *rates, target=FILTER_HZ))
    return rows


def rows(runs):
    """All of them."""
    return [*plane(runs), *logs(runs), *filtering(runs), *images(min(runs, 3))]
