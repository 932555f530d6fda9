"""Reading ten minutes at 256 Hz, and message by message in Python for comparison.

Run: ``pytest tests/benchmarks/bench_imu_reading.py --benchmark-only -s``. Medians of processor time, which is
wall time on a free core: one thread does it all.
"""

import struct
import time

import numpy as np
import pytest
from imu_logs import calibration, configured, legacy_messages, mt9_bin, mtdata2_messages, samples

from xsens.logs.read import read_log
from xsens.messages.framing import Framer
from xsens.messages.mtdata import DataLayout, OutputMode, OutputSettings

RATE_HZ, MINUTES = 256.0, 10
COUNT = int(60 * MINUTES * RATE_HZ)


@pytest.fixture(scope="module")
def s():
    return samples(COUNT, RATE_HZ)


def legacy(s):
    layout = DataLayout(OutputMode.CALIBRATED | OutputMode.ORIENTATION, OutputSettings.COUNTER)
    return configured(layout, period=450) + b"".join(legacy_messages(s, layout))


def damaged(s):
    """One message in a thousand spoiled."""
    data = bytearray(mt9_bin(s, calibration()))
    for at in np.random.default_rng(0).integers(200, len(data), COUNT // 1000):
        data[at] ^= 0x55
    return bytes(data)


def text(s):
    columns = [s["time_s"], s["accelerometer_m_s2"], s["gyroscope_rad_s"], s["magnetometer_au"]]
    rows = np.column_stack(columns).tolist()
    return ("\n".join("\t".join(f"{v:.6f}" for v in row) for row in rows) + "\n").encode()


LOGS = {
    "MT9 .bin": lambda s: mt9_bin(s, calibration()),
    "MT9 .bin, damaged": damaged,
    "legacy .mtb": legacy,
    "MTData2 .mtb": lambda s: b"".join(mtdata2_messages(s, ticks=39)),
    "MT9 text": text,
}


def median_seconds(function, *arguments, rounds=5):
    """Median processor time of a few rounds after one to warm up."""
    function(*arguments)
    times = []
    for _ in range(rounds):
        start = time.process_time()
        function(*arguments)
        times.append(time.process_time() - start)
    return float(np.median(times))


@pytest.mark.parametrize("kind", LOGS)
def test_ten_minutes(benchmark, s, kind, tmp_path):
    path = tmp_path / "log"
    path.write_bytes(LOGS[kind](s))
    log = benchmark.pedantic(read_log, (path,), rounds=3, warmup_rounds=1)
    assert len(log) > 0.998 * COUNT
    seconds = median_seconds(read_log, path)
    size = path.stat().st_size / 1e6
    print(f"\n{kind}: {MINUTES} minutes at {RATE_HZ:g} Hz, {size:.1f} MB, in {seconds:.3f} s")


def one_by_one(data):
    """What a loop over messages takes, without units or clock."""
    record = struct.Struct(">11H")
    return [record.unpack(m.payload) for m in Framer().feed(data) if len(m.payload) == record.size]


def test_against_a_loop_over_messages(benchmark, s, tmp_path):
    data = mt9_bin(s, calibration())
    path = tmp_path / "log"
    path.write_bytes(data)
    benchmark.pedantic(read_log, (path,), rounds=3, warmup_rounds=1)
    seconds, loop = median_seconds(read_log, path), median_seconds(one_by_one, data, rounds=1)
    print(
        f"\nall samples at once {seconds:.3f} s, message by message {loop:.2f} s: {loop / seconds:.1f} times"
    )
