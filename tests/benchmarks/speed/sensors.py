"""Calibrations and the orientation sensor: lines of a plane, two sweeps, logs, the filter of recordings."""

import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
from bench_image_calibration import TRUTH, prepared
from calibration_examples import scan_plane
from crossing_scenes import displaced
from imu_logs import calibration, configured, legacy_messages, mt9_bin, mtdata2_messages, samples
from scipy import optimize
from vqf import VQF, offlineVQF

from calibration.images.solver import calibrate_from_sweeps
from calibration.plane import Plane, calibrate_plane
from calibration.points import CHAIN, columns_of
from calibration.settings import ImageFit
from speed.rows import Row, timed
from xsens.fusion.orient import orient
from xsens.fusion.settings import Method
from xsens.logs.read import read_log
from xsens.logs.samples import ImuLog
from xsens.messages.mtdata import DataLayout, OutputMode, OutputSettings

LINES = 700
RATE_HZ, READ_S, FILTERED_S = 256.0, 3600.0, 600.0
PLANE_MS, IMAGES_S, READ_MB_S, READ_TIMES, FILTERED = 50.0, 3.0, 50.0, 3.0, 250e3


def legacy(made):
    """A log of calibrated samples and quaternions in Xsens' older messages."""
    layout = DataLayout(OutputMode.CALIBRATED | OutputMode.ORIENTATION, OutputSettings.COUNTER)
    return configured(layout, period=450) + b"".join(legacy_messages(made, layout))


def text(made):
    """A log as MT9's program exports it."""
    names = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")
    rows = np.column_stack([made["time_s"], *(made[name] for name in names)]).tolist()
    return ("\n".join("\t".join(f"{value:.6f}" for value in row) for row in rows) + "\n").encode()


LOGS = {
    "MT9 .bin": lambda made: mt9_bin(made, calibration()),
    "legacy .mtb": legacy,
    "MTData2 .mtb": lambda made: b"".join(mtdata2_messages(made, ticks=39)),
    "MT9 text": text,
}


def differences(equations, start, free):
    """Levenberg-Marquardt of SciPy with finite differences of the same small displacements."""
    columns = columns_of(free)

    def moved(x):
        step = np.zeros(len(CHAIN))
        step[columns] = x
        return start.displaced(step)

    return optimize.least_squares(
        lambda x: equations.residuals(moved(x)).ravel(), np.zeros(len(free)), jac="2-point", method="lm"
    )


def plane(runs):
    """All of a plane's calibration, and its least squares beside SciPy's with finite differences."""
    lines = scan_plane(np.random.default_rng(0), LINES, line_noise_mm=0.2).lines
    solution, equations = calibrate_plane(lines), Plane().equations(lines)
    start = solution.chain.displaced(np.append(np.full(5, 0.01), np.full(9, 0.02)))
    whole = timed(lambda: calibrate_plane(lines), runs)
    ours = timed(lambda: equations.least_squares(start, solution.free), runs).seconds
    theirs = timed(lambda: differences(equations, start, solution.free), runs).seconds
    what = f"calibrate_plane, {LINES} lines"
    return [
        Row(what, 1e3 * whole.seconds, "ms", target=PLANE_MS, falling=True, cores=whole.cores),
        Row(
            "its least squares once",
            1e3 * ours,
            "ms",
            "SciPy least_squares, finite differences",
            1e3 * theirs,
            falling=True,
        ),
    ]


def images(runs, seed=601):
    """A calibration from two crossing sweeps, 20 mm and 20 degrees off at most."""
    crossing, start = prepared(seed), displaced(TRUTH, np.random.default_rng(183))
    taken = timed(lambda: calibrate_from_sweeps(crossing, start, ImageFit()), runs)
    what = "calibration from two sweeps, 160 frames each"
    return [Row(what, taken.seconds, "s", target=IMAGES_S, falling=True, cores=taken.cores)]


def logs(runs):
    """Reading each kind of log: megabytes per second, and memory at most over the file's size."""
    made = samples(int(RATE_HZ * READ_S), RATE_HZ)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for kind, write in LOGS.items():
            path = Path(folder, "log")
            path.write_bytes(write(made))
            size = path.stat().st_size
            taken = timed(lambda path=path: read_log(path), runs)
            rows.append(
                Row(f"read {kind}, {size / 1e6:.0f} MB", size / 1e6 / taken.seconds, "MB/s", target=READ_MB_S)
            )
            tracemalloc.start()
            log = read_log(path)
            most, held = tracemalloc.get_traced_memory()[1] / size, _bytes(log) / size
            tracemalloc.stop()
            what = f"memory of reading {kind} over the file's size, beside the samples' own"
            rows.append(Row(what, most, "x", "samples", held, READ_TIMES, falling=True))
    return rows


def _bytes(log):
    arrays = (log.time_s, log.accelerometer_m_s2, log.gyroscope_rad_s, log.magnetometer_au, log.counter)
    quaternions = 0 if log.world_from_sensor is None else 32 * len(log)
    return sum(array.nbytes for array in arrays if array is not None) + quaternions


def filtering(runs):
    """Orientation of a recording by every method, beside VQF alone, on line or off line as the method is."""
    made = samples(int(RATE_HZ * FILTERED_S), RATE_HZ)
    vectors = [made[name] for name in ("gyroscope_rad_s", "accelerometer_m_s2", "magnetometer_au")]
    log = ImuLog(made["time_s"], vectors[1], vectors[0], vectors[2])

    peers = {
        False: ("VQF on line", lambda: VQF(1.0 / RATE_HZ).updateBatch(*vectors)),
        True: ("VQF off line", lambda: offlineVQF(*vectors, 1.0 / RATE_HZ)),
    }
    rows = []
    for method in Method:
        ours = timed(lambda method=method: orient(log, method=method), runs).seconds
        peer, run = peers[method.offline]
        rates = (len(log) / ours, "samples/s", peer, len(log) / timed(run, runs).seconds)
        rows.append(Row(f"orientation {method}, {RATE_HZ:g} Hz", *rates, target=FILTERED))
    return rows


def rows(runs):
    """All of them."""
    return [*plane(runs), *logs(runs), *filtering(runs), *images(min(runs, 3))]
