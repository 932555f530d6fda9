"""What the files of `tests/io/files_of_0_1` hold; `python tests/old_files.py FOLDER` writes such a set.

The set was written by version 0.1 at commit 8cb059c, whose files are to be read by every later version.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.calibration import Calibration, FramesUsed, Parameter, Source
from speckle3d.core.curves import CurveKey, DecorrelationCurves, NominalProbe, SpeckleSize, TiltResponse
from speckle3d.core.grid import ImageGrid
from speckle3d.core.reconstruction import (
    CalibrationFile,
    FramePairs,
    ImportRecord,
    ModeErrors,
    Provenance,
    Reconstruction,
    SharedErrors,
    SourceFile,
    Trust,
)
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import BModeSettings, OrientationSensor, RFSettings, Sweep, Tracker

FOLDER = Path(__file__).parent / "io" / "files_of_0_1"
N = 4
GRID = ImageGrid(6, 50, 0.3, 0.01925, 1.5)
RF = RFSettings(40e6, 1540.0, 5e6, (3e6, 7e6))
IQ = RFSettings(40e6, 1540.0, 5e6, (3e6, 7e6), 5e6)
WAVE = 900 * np.sin(0.37 * np.arange(N * 6 * 50)).reshape(N, 6, 50)
TURNS = Rotation.from_rotvec(np.arange(12.0).reshape(N, 3) / 40)
POSES = RigidTransform.from_components(np.arange(12.0).reshape(N, 3), TURNS)


def sensors():
    """Orientation sensor and tracker, calibrated, with offsets."""
    time_s, vectors = np.arange(N) / 20, np.arange(12.0).reshape(N, 3)
    orientation = OrientationSensor(
        TimedRotations(time_s, TURNS), TURNS[1], 0.01, vectors, vectors + 1, vectors + 2
    )
    return {
        "orientation": orientation,
        "tracker": Tracker(TimedPoses(time_s, POSES), POSES[1], -0.02, 0.01),
    }


def sweep(frames, signal=RF, **fields):
    """A sweep of the common grid and clock."""
    return Sweep(frames, GRID, signal, np.arange(N) / 25, **fields)


def sweeps():
    """By file name: a sweep and the compression it was written with."""
    pairs = np.round(WAVE) + 1j * np.round(WAVE[::-1])
    grey = np.abs(WAVE / 4).astype(np.uint8)
    return {
        "rf": (sweep(WAVE.astype(np.int16), truth=POSES, probe="L14 small parts", **sensors()), "gzip"),
        "rf_lzf": (sweep(WAVE.astype(np.int16)), "lzf"),
        "rf_plain": (sweep(WAVE.astype(np.int16)), None),
        "rf_float": (sweep(WAVE.astype(np.float32)), "gzip"),
        "iq": (sweep(pairs.astype(np.complex64), IQ), "gzip"),
        "iq_pairs": (sweep(Pairs(pairs.astype(np.complex64)), IQ), "gzip"),
        "bmode": (
            Sweep(grey, GRID, BModeSettings(60.0, 200.0), np.arange(N) / 25, tracker=sensors()["tracker"]),
            "gzip",
        ),
    }


class Pairs:
    """Complex frames that are stored as pairs of int16."""

    stored_dtype = np.dtype(np.int16)

    def __init__(self, frames):
        self.frames, self.shape, self.dtype = frames, frames.shape, frames.dtype

    def __getitem__(self, index):
        return self.frames[index]


def curves():
    """Curves by file name: of a phantom, and calculated."""
    depth, distance = np.array([10.0, 20.0, 30.0]), np.arange(5) / 10
    correlation = np.exp(-((distance / np.array([[0.3], [0.35], [0.4]])) ** 2))
    tilt, size = TiltResponse(depth / 3, depth / 5), SpeckleSize(depth / 60, depth / 300)
    numbers = (depth, distance, correlation, np.array([20.0, 25, 30]))
    key = CurveKey(RF, 0.3, 3.5, 4.0, 2.0, "echo", 0.2, "L14")
    grey = CurveKey(BModeSettings(60.0), 0.3, 3.5, 4.0, 2.0)
    probe = NominalProbe(4.0, 20.0, 8.0, 3e6, 7e6, 0.5)
    return {
        "curves": DecorrelationCurves(key, *numbers, 321, tilt, size, 0.05),
        "curves_nominal": DecorrelationCurves(grey, *numbers, origin="data sheet", nominal=probe),
    }


def calibrations():
    """Calibrations by file name: of a tracker, and of an orientation sensor."""
    parameters = (Parameter("tilt", 0.1, 0.01, "rad"), Parameter("x", 3.0, np.inf, "mm"))
    frames = FramesUsed(4, (0, 2), {1: "no line: too dark", 3: "blurred"})
    source = Source("a.h5", "ab" * 32, "0.1.0", '{"a": 1}')
    whole = Calibration(
        "plane", "tracker", TURNS[1], np.array([1.0, 2, 3]), np.array([0.1, 0.11]), np.eye(6), parameters,
        0.3, "mm", np.inf, frames, 0.02, "the motion was sufficient", source,
    )  # fmt: skip
    orientation = Calibration(
        "orientation", "orientation", TURNS[2], None, None, 1e-4 * np.eye(3), (), 0.2, "deg", 12.0,
        FramesUsed(2, (0, 1)),
    )  # fmt: skip
    return {"calibration": whole, "calibration_orientation": orientation}


def pairs():
    """Frame pairs of a reconstruction."""
    distance = np.arange(6, dtype=np.float32).reshape(3, 2)
    distance[0, 0] = np.nan
    return FramePairs(
        np.array([0, 1, 2]), np.array([1, 2, 3]), POSES[:3].as_matrix(), np.tile(np.eye(6), (3, 1, 1)),
        distance, distance / 10, distance > 2, np.arange(4.0).reshape(2, 2),
    )  # fmt: skip


def reconstructions():
    """Reconstructions by file name: with all that one may hold, and with the least."""
    covariance = np.tile(np.diag(np.arange(1.0, 7)), (N, 1, 1))
    trust = Trust(
        covariance, np.array([0, 1, 16, 0]), SharedErrors(0.02, 0.07, np.array([1e-3, 2e-3])),
        {"fused": ModeErrors(2 * covariance, 0.004)},
    )  # fmt: skip
    made_of = Provenance(
        "s.h5", "cd" * 32, "0.1.0", (CalibrationFile("tracker", "c.h5", "ef" * 32),),
        SourceFile("x.h5", "01" * 32), ImportRecord("import.toml", '{"bandwidth_hz": [1.0, 2.0]}'),
    )  # fmt: skip
    poses = {"image": POSES, "pose": POSES[::-1], "fused": POSES}
    time_s = np.arange(N) / 25
    return {
        "reconstruction": Reconstruction(
            time_s, GRID, poses, made_of, "[motion]\npatch_mm = 5.0\n", pairs(), trust
        ),
        "reconstruction_least": Reconstruction(time_s, GRID, {"image": POSES}, Provenance("s.h5", "", "")),
    }


def fill(target, content):
    """Append the readings and frames of a sweep to one that grows."""
    orientation, tracker = content.orientation, content.tracker
    for i in range(N):
        readings = orientation.readings
        turn = readings.world_from_sensor[i].as_quat(scalar_first=True)
        target.append_reading("orientation", readings.time_s[i], turn)
        if i != 2:
            target.append_reading("tracker", tracker.readings.time_s[i], POSES[i].as_matrix())
    for frame, time_s in zip(content.frames, content.frame_time_s, strict=True):
        target.append(frame, time_s)


def write_all(folder):
    """Write the set."""
    from speckle3d.io.family.calibrations import write_calibration
    from speckle3d.io.family.curves import write_curves
    from speckle3d.io.family.reconstructions import write_reconstruction
    from speckle3d.io.family.sweep_writer import GrowingSweep, write_sweep

    for name, (content, compression) in sweeps().items():
        simulation = {"seed": 3, "medium": {"a": [1, 2]}} if name == "rf_plain" else None
        write_sweep(folder / f"{name}.h5", content, compression=compression, simulation=simulation)
    for name, content in curves().items():
        write_curves(folder / f"{name}.h5", content)
    for name, content in calibrations().items():
        write_calibration(folder / f"{name}.h5", content)
    for name, content in reconstructions().items():
        write_reconstruction(folder / f"{name}.h5", content)
    content = sweeps()["rf"][0]
    for name, compression in (("growing", None), ("growing_gzip", "gzip")):
        with GrowingSweep(folder / f"{name}.h5", GRID, RF, compression=compression, probe="L14") as target:
            fill(target, content)
    with GrowingSweep(folder / "killed.h5", GRID, RF) as target:
        fill(target, content)
        left = (folder / "killed.h5").read_bytes()
    # Room on the disk that was taken in advance is not worth keeping.
    (folder / "killed.h5").write_bytes(left.rstrip(b"\0") + bytes(4096))


if __name__ == "__main__":
    write_all(Path(sys.argv[1]))
