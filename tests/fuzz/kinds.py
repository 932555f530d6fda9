"""What is fuzzed: for every kind of file, whole examples of it, how they are damaged, and who reads them."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import calibration_files
import challenge_examples
import format_examples
import image_examples
import imu_logs
import numpy as np
import speckle
import sweep_examples
from fuzz import mutations

from speckle3d.core.curves import TiltResponse
from speckle3d.core.labels import STATE_SEGMENTS, LabelMap
from speckle3d.core.reconstruction import FramePairs, ModeErrors, Provenance, SharedErrors, Trust
from speckle3d.core.surface import Surface
from speckle3d.core.volume import Volume
from speckle3d.io.calibrations import write_calibration
from speckle3d.io.curves import write_curves
from speckle3d.io.reconstructions import ReconstructionWriter
from speckle3d.io.shapes.surfaces import write_surface
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.io.tum import write_tum
from speckle3d.io.voxels.volumes import write_volume

XML = """<PlusConfiguration version="2.1"><CoordinateDefinitions>
<Transform From="Phantom" To="Reference" Matrix="0 -1 0 10  1 0 0 20  0 0 1 30  0 0 0 1" />
</CoordinateDefinitions><Segmentation ApproximateSpacingMmPerPixel="0.078"
 ClipRectangleOrigin="27 28" ClipRectangleSize="766 562" />
<PhantomDefinition><Geometry><Pattern Type="NWire">
 <Wire Name="a" EndPointFront="30 0 20" EndPointBack="30 40 20" />
 <Wire Name="b" EndPointFront="55 0 20" EndPointBack="35 40 20" />
 <Wire EndPointFront="60 0 20" EndPointBack="60 40 20" />
</Pattern></Geometry></PhantomDefinition></PlusConfiguration>
"""
POINTS = "# by hand\nframe,column_px,row_px,wire\n0,605.7,191.9,G1\n0,436.2,181.1,1\n3,5,6.5,0\n"
PICKS = "name,x_mm,y_mm,z_mm\n# the vessel\na,605.7,191.9,-3\nb,1,2.5,1e1  # its end\n"
LOGS = (
    "time_s,counter,acc_x,acc_y,acc_z\n0,1,0,0,9.8\n0.1,2,0,0,9.8\n0.2,3,0,0.1,9.8\n",
    "PacketCounter\tAcc_X\tAcc_Y\tAcc_Z\tMat[1][1]\n00472\t\t0.1\t4.8\t-8.5\n00473\t1\t2\t3\t4\n",
    "sep=,\nDeviceTag:,x\nOutputRate:,60Hz\nPacketCounter,SampleTimeFine,Quat_W,Quat_X,Quat_Y,Quat_Z\n1,5,1,0,0,0\n",
)


@dataclass
class Kind:
    """Files of one kind.

    Attributes
    ----------
    write : callable
        Writes whole examples into a folder; returns their paths.
    read : callable
        Reads one with everything in it.
    damage : callable
        Changes the file at a path.
    seconds, beside_bytes : float, int
        Most that one case may take, and its memory beside twice the file.
    """

    write: Any
    read: Any
    damage: Any
    seconds: float = 10.0
    beside_bytes: int = 160 * 2**20


def bytes_of(change):
    return lambda rng, path: path.write_bytes(change(rng, path.read_bytes()))


def sweeps(folder):
    paths = [folder / f"{i}.h5" for i in range(6)]
    write_sweep(paths[4], sweep_examples.iq_sweep())
    write_sweep(paths[5], sweep_examples.iq_sweep(paired=False), compression=None)
    write_sweep(paths[0], sweep_examples.rf_sweep())
    write_sweep(paths[1], sweep_examples.rf_sweep(dtype=np.float32), compression="lzf")
    write_sweep(paths[2], sweep_examples.bmode_sweep(), compression=None)
    write_sweep(paths[3], replace(sweep_examples.rf_sweep(), tracker=None, truth=None))
    return paths


def curves(folder):
    tilt = TiltResponse(np.array([-7.5, 11.0]), np.array([1.5, 7.25]))
    write_curves(folder / "c.h5", replace(speckle.curves(sigma_mm=[0.3, 0.6]), tilt=tilt))
    return [folder / "c.h5"]


def calibrations(folder):
    for sensor in ("tracker", "orientation"):
        write_calibration(folder / f"{sensor}.h5", calibration_files.made(sensor))
    return [folder / "tracker.h5", folder / "orientation.h5"]


def reconstructions(folder, n=8, patches=6):
    rng = np.random.default_rng(0)
    pairs = FramePairs(
        first=np.arange(n - 1),
        second=np.arange(1, n),
        first_from_second=sweep_examples.poses(n - 1).as_matrix(),
        covariance=np.tile(np.eye(6), (n - 1, 1, 1)),
        distance_mm=rng.random((n - 1, patches)).astype(np.float32),
        sigma_mm=rng.random((n - 1, patches)).astype(np.float32),
        used=rng.random((n - 1, patches)) > 0.5,
        patch_centre_mm=np.arange(2.0 * patches).reshape(patches, 2),
    )
    poses = {"image": sweep_examples.poses(n), "pose": sweep_examples.poses(n, 1)}
    each = np.tile(np.eye(6), (n, 1, 1))
    shared, modes = SharedErrors(0.02, 0.07, np.array([1e-3, 2e-3])), {"fused": ModeErrors(each, 0.004)}
    trust = Trust(each, np.zeros(n, dtype=np.int64), shared, modes)
    with ReconstructionWriter(folder / "r.h5", 0.04 * np.arange(n), sweep_examples.rf_sweep().grid) as writer:
        writer.append_pairs(pairs)
        writer.finish(poses, Provenance("sweep.h5", "ab" * 32, "0.1.0"), "[matching]\n", trust)
    return [folder / "r.h5"]


def scans(folder):
    return [challenge_examples.write_data_set(folder, split=False)[0]]


def trajectories(folder):
    write_tum(folder / "t.txt", np.arange(20) / 10, sweep_examples.poses(20))
    return [folder / "t.txt"]


def configurations(folder):
    from speckle3d.config import Config

    (folder / "c.toml").write_text(Config().to_toml(), encoding="utf-8")
    return [folder / "c.toml"]


def texts(suffix, *contents):
    def write(folder):
        paths = [folder / f"{i}{suffix}" for i in range(len(contents))]
        for path, content in zip(paths, contents, strict=True):
            path.write_text(content, encoding="utf-8")
        return paths

    return write


def metaimages(folder):
    _, _, frames = image_examples.tracked(3)
    plain = image_examples.write_mha(folder / "a.mha", image_examples.grey(), frames=frames)
    content = plain.read_bytes().replace(b"ElementDataFile = LOCAL", b"ElementDataFile = b.raw")
    head, _, pixels = content.partition(b"b.raw\n")
    (folder / "b.mhd").write_bytes(head + b"b.raw\n")
    (folder / "b.raw").write_bytes(pixels)
    import zlib

    head, _, pixels = plain.read_bytes().partition(b"LOCAL\n")
    packed = zlib.compress(pixels)
    head = head.replace(
        b"CompressedData = False", f"CompressedData = True\nCompressedDataSize = {len(packed)}".encode()
    )
    (folder / "c.mha").write_bytes(head + b"LOCAL\n" + packed)
    pairs = np.random.default_rng(0).integers(-32768, 32767, (3, 4, 6)).astype(np.int16)
    fields = {"UltrasoundImageOrientation": "NM", "UltrasoundImageType": "RF_I_LINE_Q_LINE"}
    echoes = image_examples.write_mha(folder / "d.mha", pairs, fields, frames, "0.02 0.3 1")
    return [plain, folder / "b.mhd", folder / "c.mha", echoes]


def nrrds(folder):
    import gzip

    fields = "\n".join(
        f"Seq_Frame{i:04d}_{name}:={value}"
        for i, frame in enumerate(image_examples.tracked(3)[2])
        for name, value in frame.items()
    )
    paths = []
    for encoding, packed in (("raw", bytes), ("gzip", gzip.compress)):
        head = (
            f"NRRD0004\ndimension: 3\nencoding: {encoding}\nendian: little\nkinds: domain domain list\n"
            f"sizes: 5 4 3\nspace directions: (1,0) (0,1) none\ntype: uint8\n{fields}\n\n"
        )
        paths.append(folder / f"{encoding}.nrrd")
        paths[-1].write_bytes(head.encode() + packed(image_examples.grey().tobytes()))
    return paths


def volumes(folder):
    voxels = np.random.default_rng(0).integers(0, 256, (4, 5, 6)).astype(np.uint8)
    place = (0.5, 0.25, 1.0), sweep_examples.poses(1)[0], {"levels": "linear", "note": "two\nlines"}
    volume, labels = Volume(voxels, *place), LabelMap(voxels % 3, *place, STATE_SEGMENTS)
    of_volume = [folder / name for name in ("v.nrrd", "v.mha", "v.nii.gz", "u.nrrd", "u.mha", "u.nii")]
    of_labels = [folder / name for name in ("l.seg.nrrd", "l.mha", "l.nii")]
    for path in (*of_volume, *of_labels):
        write_volume(path, labels if path in of_labels else volume, compress=path.name.startswith("v"))
    return [*of_volume, *of_labels]


def surfaces(folder):
    corners = np.random.default_rng(0).normal(size=(12, 3))
    triangles = np.arange(12).reshape(4, 3)
    for suffix in (".stl", ".ply", ".vtk"):
        write_surface(folder / f"s{suffix}", Surface(corners, triangles))
    return [folder / f"s{suffix}" for suffix in (".stl", ".ply", ".vtk")]


def streams(folder):
    s = imu_logs.samples(4)
    unit = imu_logs.calibration()
    (folder / "a.bin").write_bytes(imu_logs.mt9_bin(s, unit))
    for form in range(3):
        (folder / f"{form}.bin").write_bytes(b"".join(imu_logs.mtdata2_messages(s, form=form)))
    layout = imu_logs.DataLayout(imu_logs.OutputMode.CALIBRATED | imu_logs.OutputMode.ORIENTATION, 0)
    legacy = imu_logs.configured(layout) + b"".join(imu_logs.legacy_messages(s, layout))
    (folder / "l.bin").write_bytes(legacy)
    return sorted(folder.glob("*.bin"))


def messages(folder):
    from igtl_examples import stream

    paths = [folder / "small.igtl", folder / "large.igtl"]
    for path, columns in zip(paths, (6, 127), strict=True):
        path.write_bytes(stream(columns))
    return paths


def damage_messages(rng, path):
    """Damage the bytes of a stream, or a header or a body of it whose check sum is made right again."""
    from igtl_examples import damaged_message, messages_of

    content = path.read_bytes()
    if rng.random() < 0.3:
        path.write_bytes(mutations.of_bytes(rng, content))
        return
    pieces = messages_of(content)
    k = int(rng.integers(0, len(pieces)))
    pieces[k] = damaged_message(rng, pieces[k])
    path.write_bytes(b"".join(pieces))


def read_messages(path):
    """Take what is whole of a stream, which must not cost the message that follows it."""
    from igtl_examples import LAST, received

    found = received(path.read_bytes() + LAST)
    if not found or getattr(found[-1], "device", "") != "Last":
        raise AssertionError(f"the message behind the damaged ones was lost: {found[-3:]}")


def small_sweep(folder):
    """A sweep of 12 frames with both sensors, and the curves for it."""
    import shutil

    from speckle3d.simulation.presets import SimulationSettings, simulate

    settings = SimulationSettings(preset="tissue", vectors=26, samples=1000, seed=5, length_mm=1.5, frames=12)
    write_sweep(folder / "s.h5", simulate(settings)[0].sweep)
    shutil.copy(Path(__file__).resolve().parents[2] / "data" / "curves.h5", folder / "curves.h5")
    return [folder / "s.h5", folder / "curves.h5"]


GIVEN = """vector_pitch_mm = 0.3
centre_frequency_hz = 6e6
demodulation_frequency_hz = 6e6
bandwidth_hz = [4.5e6, 7e6]
column_pitch_mm = 0.2
row_spacing_mm = 0.1
dynamic_range_db = 60.0
frame_rate_hz = 20.0
"""


def given(folder, more=""):
    (folder / "import.toml").write_text(GIVEN + more, encoding="utf-8")


def uffs(folder):
    given(folder)
    return [
        format_examples.write_uff(folder / "a.uff", format_examples.iq(), 6e6),
        format_examples.write_uff(folder / "b.uff", format_examples.rf()),
        format_examples.write_uff(folder / "c.uff", np.abs(format_examples.iq())),
    ]


def zeas(folder):
    given(folder)
    amplitude = np.abs(format_examples.iq())
    return [
        format_examples.write_zea(folder / "a.hdf5", format_examples.iq()),
        format_examples.write_zea(folder / "b.hdf5", format_examples.rf(), home="tracks/a/"),
        format_examples.write_zea(folder / "c.hdf5", amplitude, "envelope_data"),
        format_examples.write_zea(folder / "d.hdf5", format_examples.grey(), "image"),
    ]


def mats(new):
    def write(folder):
        arrays = '[arrays]\nrf = "data{1}.rf"\naxes = "sample, vector, frame"\ntime_s = "t / 2"\n'
        given(folder, f"sampling_rate_hz = 15e6\n{arrays}")
        data = format_examples.matlab_order(format_examples.rf())
        held = {"data": [{"rf": data, "gain": 3.0}], "t": np.arange(4.0), "note": "words"}
        kinds = [new] if new else [True, False]
        return [
            format_examples.write_mat(folder / f"{packed:d}.mat", new, packed=packed, **held)
            for packed in kinds
        ]

    return write


def dicoms(folder):
    from pydicom.uid import RLELossless

    given(folder)
    images = np.random.default_rng(0).integers(0, 256, (3, 20, 16)).astype(np.uint8)
    colours = np.repeat(images[..., None], 3, axis=3)
    regions = [format_examples.region(2, 3, 11, 15)]
    return [
        format_examples.write_dicom(folder / "a.dcm", images, regions),
        format_examples.write_dicom(folder / "b.dcm", images, regions, syntax=RLELossless),
        format_examples.write_dicom(folder / "c.dcm", colours, regions, "RGB", FrameTimeVector=[0, 20, 30]),
        format_examples.write_dicom(folder / "d.dcm", images, PixelSpacing=[0.1, 0.2]),
    ]


def ultrasonics(folder):
    given(folder)
    return [
        format_examples.write_ultrasonix(folder / "a.rf", format_examples.rf()),
        format_examples.write_ultrasonix(folder / "b.rf", format_examples.rf(), tags=True),
        format_examples.write_ultrasonix(folder / "c.b8", format_examples.grey(), 4),
    ]


def read_sweep(path):
    from speckle3d.io.describe import describe
    from speckle3d.io.load import load_sweep

    sweep = load_sweep(path)
    for i in range(min(len(sweep), 50)):
        sweep.frames[i]
    getattr(sweep.frames, "close", lambda: None)()
    describe(path)


def read_described(reader):
    def read(path):
        from speckle3d.io.describe import describe

        reader(path)
        describe(path)

    return read


def read_image(path):
    from speckle3d.io.import_settings import ImportSettings
    from speckle3d.io.metaimage import read_metaimage, read_poses
    from speckle3d.io.plus.write import write_sequence

    grey = {"column_pitch_mm": 0.1, "row_spacing_mm": 0.2, "dynamic_range_db": 60.0}
    echoes = {"centre_frequency_hz": 6e6, "bandwidth_hz": (4e6, 8e6), "demodulation_frequency_hz": 0.0}
    sweep = read_metaimage(path, ImportSettings(**grey, **echoes))
    try:
        # Reads all frames, and what is written of their fields is read as well.
        write_sequence(path.with_name("written.mha"), sweep)
        read_metaimage(path.with_name("written.mha"))
    finally:
        sweep.frames.close()
    read_poses(path)


def read_stream(path):
    from xsens.logs.read import parse_stream

    parse_stream(path.read_bytes())


def run_track(path):
    """Track a sweep and correct it by each of its sensors; the other file of the two is whole."""
    from speckle3d.core.errors import Speckle3DError
    from speckle3d.corrections import correct
    from speckle3d.io.curves import read_curves
    from speckle3d.io.load import load_sweep
    from speckle3d.pipeline import track

    beside = path.with_name("curves.h5" if path.name == "s.h5" else "s.h5")
    sweep_path, curves_path = (path, beside) if path.name == "s.h5" else (beside, path)
    sweep = load_sweep(sweep_path)
    try:
        tracked = track(sweep, read_curves(curves_path))
        for mode in ("orientation", "pose"):
            try:
                correct(tracked, sweep, [mode])
            except Speckle3DError:
                continue
    finally:
        sweep.frames.close()


def kinds():
    from speckle3d.config import load_config
    from speckle3d.io.calibrations import read_calibration
    from speckle3d.io.curves import read_curves
    from speckle3d.io.plus_config import read_wire_phantom
    from speckle3d.io.points import read_points
    from speckle3d.io.reconstructions import read_reconstruction
    from speckle3d.io.shapes.picks import read_places
    from speckle3d.io.shapes.surfaces import read_surface
    from speckle3d.io.tum import read_tum
    from speckle3d.io.voxels.volumes import read_volume
    from xsens.logs.parts import Hints
    from xsens.logs.read import read_log

    hdf5, text, raw = mutations.of_hdf5, bytes_of(mutations.of_text), bytes_of(mutations.of_bytes)
    return {
        "sweep": Kind(sweeps, read_sweep, hdf5),
        "igtl": Kind(messages, read_messages, damage_messages),
        "curves": Kind(curves, read_described(read_curves), hdf5),
        "calibration": Kind(calibrations, read_described(read_calibration), hdf5),
        "reconstruction": Kind(reconstructions, read_described(read_reconstruction), hdf5),
        "scan": Kind(scans, read_sweep, hdf5),
        "uff": Kind(uffs, read_sweep, hdf5),
        "zea": Kind(zeas, read_sweep, hdf5),
        "mat": Kind(mats(False), read_sweep, raw),
        "mat73": Kind(mats(True), read_sweep, hdf5),
        "dicom": Kind(dicoms, read_sweep, raw),
        "ultrasonix": Kind(ultrasonics, read_sweep, raw),
        "tum": Kind(trajectories, read_tum, text),
        "toml": Kind(configurations, load_config, text),
        "xml": Kind(texts(".xml", XML), read_wire_phantom, text),
        "points": Kind(texts(".csv", POINTS), lambda path: read_points(path, ("G1", "G2")), text),
        "log": Kind(texts(".txt", *LOGS), lambda path: read_log(path, Hints(rate_hz=100.0)), text),
        "metaimage": Kind(metaimages, read_image, text),
        "nrrd": Kind(nrrds, read_image, text),
        "volume": Kind(volumes, read_volume, text),
        "surface": Kind(surfaces, read_surface, raw),
        "picks": Kind(texts(".csv", PICKS), read_places, text),
        "stream": Kind(streams, read_stream, raw, seconds=5.0),
        "track": Kind(small_sweep, run_track, hdf5, seconds=60.0, beside_bytes=512 * 2**20),
    }
