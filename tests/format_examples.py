"""Small recordings in the formats of others, written as their own tools write them."""

import struct

import h5py
import numpy as np

FRAMES, VECTORS, SAMPLES = 4, 6, 40
PITCH_MM, SPACING_MM, FIRST_MM = 0.3, 0.0493, 4.0


def rf(seed=0, frames=FRAMES, vectors=VECTORS, samples=SAMPLES):
    return np.random.default_rng(seed).integers(-2000, 2000, (frames, vectors, samples)).astype(np.int16)


def grey(seed=0, frames=FRAMES, vectors=VECTORS, samples=SAMPLES):
    return np.random.default_rng(seed).integers(0, 256, (frames, vectors, samples)).astype(np.uint8)


def iq(seed=0, **shape):
    return (rf(seed, **shape) + 1j * rf(seed + 1, **shape)).astype(np.complex64)


def axes(vectors=VECTORS, samples=SAMPLES):
    """Lateral positions and depths, m."""
    x = PITCH_MM * (np.arange(vectors) - (vectors - 1) / 2)
    return 1e-3 * x, 1e-3 * (FIRST_MM + SPACING_MM * np.arange(samples))


def write_uff(path, frames, modulation_hz=0.0, pulse=(6e6, 0.5), scan="uff.linear_scan", name="b_data"):
    """Write beamformed data as USTB does from MATLAB: axes in reverse, last ones of length 1 left out."""
    data = frames.reshape(len(frames), 1, 1, -1)
    if len(frames) == 1:
        data = data.reshape(1, -1)
    x, z = axes(*frames.shape[1:])
    with h5py.File(path, "a") as file:
        file.attrs["version"] = np.array([b"v1.2.0"])
        group = _object(file, name, "uff.beamformed_data")
        _put(group, "data", data)
        _put(group, "modulation_frequency", np.array([[modulation_hz]]))
        _put(group, "frame_rate", np.array([[1.0]]))
        held = _object(group, "scan", scan)
        for axis, values in (("x_axis", x), ("z_axis", z)):
            _put(held, axis, values[None])
        for axis, values in (("x", np.repeat(x, z.size)), ("z", np.tile(z, x.size))):
            _put(held, axis, values[None])
        if pulse is not None:
            held = _object(group, "pulse", "uff.pulse")
            _put(held, "center_frequency", np.array([[pulse[0]]]))
            _put(held, "fractional_bandwidth", np.array([[pulse[1]]]))
    return path


def _object(group, name, kind):
    made = group.create_group(name)
    made.attrs.update({"class": kind, "name": name, "size": [1.0, 1.0], "array": 0.0})
    return made


def _put(group, name, values):
    if np.iscomplexobj(values):
        made = group.create_group(name)
        made.attrs.update({"class": "single", "name": name, "complex": 1.0})
        made["real"], made["imag"] = values.real.astype("f4"), values.imag.astype("f4")
        return
    group[name] = values.astype("f4")
    group[name].attrs.update({"class": "single", "name": name, "complex": 0.0, "imaginary": 0.0})


def write_ultrasonix(path, frames, kind=16, tags=False, **given):
    """Write `frames` (frame, vector, sample) after 19 integers; rows lie together in images (type 4)."""
    n, width, height = frames.shape
    bits = 8 * frames.itemsize
    values = {"probe": 2, "transmit_hz": 6_660_000, "sampling_hz": 40_000_000, "rate": 31} | given
    head = [kind, n, width, height, bits, 0, 0, width - 1, 0, width - 1, height - 1, 0, height - 1]
    head += [values["probe"], values["transmit_hz"], values["sampling_hz"], values["rate"], 128, 0]
    turned = frames.transpose(0, 2, 1) if kind == 4 else frames
    parts = [struct.pack("<19i", *head)]
    for i, frame in enumerate(turned):
        parts += [struct.pack("<i", i)] * tags + [np.ascontiguousarray(frame).tobytes()]
    path.write_bytes(b"".join(parts))
    return path


TISSUE = {
    "RegionSpatialFormat": 1,
    "RegionDataType": 1,
    "RegionFlags": 2,
    "PhysicalUnitsXDirection": 3,
    "PhysicalUnitsYDirection": 3,
    "PhysicalDeltaX": 0.011,
    "PhysicalDeltaY": 0.007,
    "ReferencePixelX0": 3,
    "ReferencePixelY0": 0,
    "ReferencePixelPhysicalValueX": 0.0,
    "ReferencePixelPhysicalValueY": 0.25,
}
BOX = ("RegionLocationMinX0", "RegionLocationMinY0", "RegionLocationMaxX1", "RegionLocationMaxY1")


def region(left, top, right, bottom, **changes):
    from pydicom.dataset import Dataset

    made = Dataset()
    for name, value in (TISSUE | dict(zip(BOX, (left, top, right, bottom), strict=True)) | changes).items():
        if value is not None:
            setattr(made, name, value)
    return made


def write_dicom(path, images, regions=(), photometric="MONOCHROME2", syntax=None, **elements):
    """Write `images` (frame, row, column[, colour]) as an ultrasound scanner does."""
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.sequence import Sequence
    from pydicom.uid import ExplicitVRLittleEndian, UltrasoundMultiFrameImageStorage, generate_uid

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = UltrasoundMultiFrameImageStorage
    meta.MediaStorageSOPInstanceUID = generate_uid(entropy_srcs=["speckle3d"])
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    made = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)
    made.SOPClassUID, made.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    made.Modality, made.Manufacturer, made.PatientName = "US", "Someone", "Doe^Jane"
    made.NumberOfFrames, made.Rows, made.Columns = images.shape[:3]
    made.SamplesPerPixel = images.shape[3] if images.ndim == 4 else 1
    if images.ndim == 4:
        made.PlanarConfiguration = 0
    made.PhotometricInterpretation = photometric
    made.BitsAllocated = made.BitsStored = 8 * images.itemsize
    made.HighBit, made.PixelRepresentation = 8 * images.itemsize - 1, 0
    if regions:
        made.SequenceOfUltrasoundRegions = Sequence(regions)
    for name, value in ({"FrameTime": 40.0} | elements).items():
        if value is not None:
            setattr(made, name, value)
    made.PixelData = images.tobytes()
    if syntax is not None:
        made.compress(syntax)
    made.save_as(path, enforce_file_format=True)
    return path
