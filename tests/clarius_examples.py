"""Clarius raw packages of any sweep, as the scanner writes them: for tests.

The layout, units and conventions are those of the maker's documents and of two public recordings, as told in
``speckle3d/io/clarius``; the writer shares no code with the reader.
"""

import struct
import tarfile
import zlib
from dataclasses import replace

import lzallright
import numpy as np
from scipy.spatial.transform import Rotation
from sweep_examples import rf_sweep

from speckle3d.core.grid import ImageGrid
from speckle3d.core.streams import TimedRotations
from speckle3d.core.sweep import BModeSettings, OrientationSensor, RFSettings
from speckle3d.io.import_settings import ImportSettings

NAME = "2024-05-01T10-00-00+0000"
ELEMENT_MM = 0.2
"""Of an L7 HD3."""

IMPORT_SETTINGS = ImportSettings(probe="Clarius L7 HD3", bandwidth_hz=(4e6, 8e6), dynamic_range_db=60)

BLOCK_BYTES = 256 * 1024
G = 9.80665


def sweep_of(kind, frames=4, samples=40):
    """A sweep of noise, its sensor in bursts: "rf", "iq" or "env"; `IMPORT_SETTINGS` has what it lacks."""
    sweep, times, rng = rf_sweep(frames, 5, samples), bursts_s(9.9, 10.4), np.random.default_rng(1)
    # At 11 frames/s and every third frame left out, as RF is interleaved.
    clock = 10.0 + np.delete(np.arange(3 * frames), slice(None, None, 3))[:frames] / 11
    sensor = sensor_of(sway(times), times)
    sweep = replace(sweep, orientation=sensor, tracker=None, truth=None, frame_time_s=np.round(clock, 9))
    if kind == "env":
        data = rng.integers(0, 256, sweep.frames.shape).astype(np.uint8)
        sweep = replace(sweep, frames=data, signal=BModeSettings(60.0))
    if kind == "iq":
        pairs = rng.integers(-3000, 3000, (*sweep.frames.shape, 2)).astype(np.float32)
        signal = RFSettings(15e6, 1540.0, 6e6, (4e6, 8e6), 6e6)
        grid = ImageGrid(5, samples, 0.3, signal.sample_spacing_mm, 2.0)
        sweep = replace(sweep, frames=pairs.view(np.complex64)[..., 0], signal=signal, grid=grid)
    return sweep


def write_package(target, sweep, **fields):
    """Write a folder, or a tar file where the target's name says so."""
    return write_files(target, package_files(sweep, **fields))


def write_files(target, files):
    folder = target.with_suffix("") if target.suffix == ".tar" else target
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    if target.suffix == ".tar":
        with tarfile.open(target, "w") as archive:
            for name in files:
                archive.add(folder / name, name)
    return target


def package_files(sweep, lzop=False, name=NAME, element_mm=ELEMENT_MM, yml=None):
    """Content of a package's files by name."""
    kind, raw = kind_of(sweep), raw_bytes(sweep)
    files = {
        f"{name}_{kind}.raw{'.lzo' if lzop else ''}": lzop_bytes(raw) if lzop else raw,
        f"{name}_{kind}.yml": (yml or yml_text(sweep, element_mm)).encode(),
    }
    if sweep.orientation is not None:
        files[f"{name}_imu.yml"] = sensor_text(sweep.orientation).encode()
    return files


def kind_of(sweep):
    if isinstance(sweep.signal, BModeSettings):
        return "env"
    return "rf" if sweep.signal.demodulation_frequency_hz is None else "iq"


SAMPLE_BYTES, TYPE_NAMES = {"rf": 2, "iq": 4, "env": 1}, {"rf": "RF", "iq": "IQ", "env": "B pre-scan"}


def raw_bytes(sweep):
    kind = kind_of(sweep)
    parts = [struct.pack("<5I", 1, *sweep.frames.shape, SAMPLE_BYTES[kind])]
    for i, time_s in enumerate(sweep.frame_time_s):
        frame = sweep.frames[i]
        if kind == "iq":
            frame = np.stack([frame.real, frame.imag], axis=-1)
        dtype = np.uint8 if kind == "env" else "<i2"
        parts += [struct.pack("<Q", round(time_s * 1e9)), np.round(frame).astype(dtype).tobytes()]
    return b"".join(parts)


def yml_text(sweep, element_mm=ELEMENT_MM):
    """The description; the delay has the microsecond that passes before depth 0."""
    n, lines, samples = sweep.frames.shape
    grid, signal, kind = sweep.grid, sweep.signal, kind_of(sweep)
    rate_hz = getattr(signal, "sampling_rate_hz", 1540e3 / (2 * grid.sample_spacing_mm))
    delay = rate_hz * (grid.first_sample_depth_mm * 2e-3 / 1540.0 + 1e-6)
    step = grid.vector_pitch_mm / element_mm
    places = "".join(f"  - {{rx element: {i * step!r}, angle: 0 °}}\n" for i in range(lines))
    shift = getattr(signal, "demodulation_frequency_hz", None)
    return (
        f"# raw data parameters\n\nframes: {n}\nframe rate: 11 Hz\n"
        f"transmit frequency: {getattr(signal, 'centre_frequency_hz', 10e6) / 1e6!r} MHz\n"
        "tgc: { 0.00mm, 23.00dB }{ 40.00mm, 26.00dB }\n"
        f"size: {{samples per line: {samples}, number of lines: {lines}, "
        f"sample size: {SAMPLE_BYTES[kind]} bytes}}\n"
        f"type: {TYPE_NAMES[kind]}\ncompression: none\n"
        f"sampling rate: {rate_hz / 1e6!r} MHz\ndelay samples: {delay!r}\nlines:\n{places}"
        + (focus_text(shift / 1e6, shift / 1e6) if shift else "")
    )


def focus_text(shallow_mhz, deep_mhz):
    ends = f"shallowfreq: {shallow_mhz!r} MHz, deepfreq: {deep_mhz!r} MHz, filterdepth: 40 mm"
    return f"focus:\n  - depth: 20 mm\n    receive:\n      - {{{ends}}}\n"


def sensor_text(sensor):
    """Samples of the sensor, documents of YAML: accelerometer in g, against the specific force."""
    quaternions = sensor.readings.world_from_sensor.as_quat(scalar_first=True)
    vectors = {
        "gyroscope": sensor.gyroscope_rad_s,
        "accelerometer": -sensor.accelerometer_m_s2 / G,
        "magnetometer": sensor.magnetometer_au,
    }
    documents = []
    for i, time_s in enumerate(sensor.readings.time_s):
        lines = [f"timestamp: {round(time_s * 1e9)}"]
        for name, values in vectors.items():
            lines += [
                f"{name} {axis}: {value!r}" for axis, value in zip("xyz", values[i].tolist(), strict=True)
            ]
        turn = ", ".join(f"q{k}: {value!r}" for k, value in enumerate(quaternions[i].tolist()))
        documents.append("\n".join([*lines, f"orientation: {{{turn}}}", "stationary: false\n"]))
    return "---\n".join(documents)


def sensor_of(rotations, time_s):
    """Stream of a sensor that turns so in the package's world, with the vectors that it measures."""
    rng = np.random.default_rng(0)
    shape = (len(rotations), 3)
    into = rotations.inv()
    turns = (rotations[:-1].inv() * rotations[1:]).as_rotvec() / np.diff(time_s)[:, None]
    rate = np.vstack([turns[:1], 0.5 * (turns[1:] + turns[:-1]), turns[-1:]])
    return OrientationSensor(
        TimedRotations(time_s, rotations),
        accelerometer_m_s2=into.apply([0.0, 0.0, G]) + rng.normal(0, 0.05, shape),
        gyroscope_rad_s=rate + rng.normal(0, 0.001, shape),
        magnetometer_au=into.apply([0.4, 0.0, -1.0]) + rng.normal(0, 0.01, shape),
    )


def sway(time_s, degrees=8.0):
    """Rotations of a hand that tilts slowly."""
    phase = 2 * np.pi * np.asarray(time_s)[:, None] * [0.31, 0.23, 0.17]
    return Rotation.from_euler("zyx", np.array([70.0, 20.0, 80.0]) + degrees * np.sin(phase), degrees=True)


def bursts_s(start_s, stop_s):
    """Times of samples that come three by three, 12 ms apart, 50 ms between."""
    times, t = [], start_s
    while t < stop_s:
        times += [t, t + 0.012, t + 0.024]
        t += 0.074
    return np.round(np.array(times), 9)


def lzop_bytes(content):
    """Content packed as by lzop, with Adler-32 of the unpacked blocks."""
    head = struct.pack(">HHHBBIIII", 0x1040, 0x20A0, 0x0940, 1, 5, 0x3000001, 0x81A4, 0, 0) + b"\5x.raw"
    parts = [b"\x89LZO\x00\r\n\x1a\n", head, struct.pack(">I", zlib.adler32(head))]
    compressor = lzallright.LZOCompressor()
    for at in range(0, len(content), BLOCK_BYTES):
        plain = content[at : at + BLOCK_BYTES]
        block = min(compressor.compress(plain), plain, key=len)
        parts += [struct.pack(">III", len(plain), len(block), zlib.adler32(plain)), block]
    return b"".join([*parts, struct.pack(">I", 0)])
