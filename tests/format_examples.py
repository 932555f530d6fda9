"""Small recordings in the formats of others, written as their own tools write them."""

import struct

import h5py
import numpy as np

FRAMES, VECTORS, SAMPLES = 4, 6, 40
PITCH_MM, SPACING_MM, FIRST_MM = 0.3, 0.0493, 4.0


def rf(seed=0, frames=FRAMES):
    return np.random.default_rng(seed).integers(-2000, 2000, (frames, VECTORS, SAMPLES)).astype(np.int16)


def grey():
    return np.random.default_rng(0).integers(0, 256, (FRAMES, VECTORS, SAMPLES)).astype(np.uint8)


def iq(frames=FRAMES):
    return (rf(0, frames) + 1j * rf(1, frames)).astype(np.complex64)


def axes(vectors=VECTORS, samples=SAMPLES):
    """Lateral positions and depths, m, of the examples' grid."""
    x = PITCH_MM * (np.arange(vectors) - (vectors - 1) / 2)
    return 1e-3 * x, 1e-3 * (FIRST_MM + SPACING_MM * np.arange(samples))


def write_uff(path, frames, modulation_hz=0.0, scan="uff.linear_scan"):
    """Write beamformed data as USTB does from MATLAB: axes in reverse, last ones of length 1 left out."""
    data = frames.reshape(len(frames), 1, 1, -1)
    if len(frames) == 1:
        data = data.reshape(1, -1)
    x, z = axes(*frames.shape[1:])
    with h5py.File(path, "a") as file:
        file.attrs["version"] = np.array([b"v1.2.0"])
        group = _object(file, "b_data", "uff.beamformed_data")
        _put(group, "data", data)
        _put(group, "modulation_frequency", np.array([[modulation_hz]]))
        _put(group, "frame_rate", np.array([[1.0]]))
        part = _object(group, "scan", scan)
        for axis, values in (("x_axis", x), ("z_axis", z)):
            _put(part, axis, values[None])
        for axis, values in (("x", np.repeat(x, z.size)), ("z", np.tile(z, x.size))):
            _put(part, axis, values[None])
        part = _object(group, "pulse", "uff.pulse")
        _put(part, "center_frequency", np.array([[6e6]]))
        _put(part, "fractional_bandwidth", np.array([[0.5]]))
    return path


def _object(group, name, kind):
    child = group.create_group(name)
    child.attrs.update({"class": kind, "name": name, "size": [1.0, 1.0], "array": 0.0})
    return child


def _put(group, name, values):
    if np.iscomplexobj(values):
        child = group.create_group(name)
        child.attrs.update({"class": "single", "name": name, "complex": 1.0})
        child["real"], child["imag"] = values.real.astype("f4"), values.imag.astype("f4")
        return
    group[name] = values.astype("f4")
    group[name].attrs.update({"class": "single", "name": name, "complex": 0.0, "imaginary": 0.0})


def write_ultrasonix(path, frames, kind=16, tags=False, **fields):
    """Write `frames` (frame, vector, sample) after 19 integers; rows lie together in images (type 4)."""
    n, width, height = frames.shape
    bits = 8 * frames.itemsize
    values = {"probe": 2, "transmit_hz": 6_660_000, "sampling_hz": 40_000_000, "rate": 31} | fields
    head = [kind, n, width, height, bits, 0, 0, width - 1, 0, width - 1, height - 1, 0, height - 1]
    head += [values["probe"], values["transmit_hz"], values["sampling_hz"], values["rate"], 128, 0]
    images = frames.transpose(0, 2, 1) if kind == 4 else frames
    parts = [struct.pack("<19i", *head)]
    for i, frame in enumerate(images):
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

    area = Dataset()
    for name, value in (TISSUE | dict(zip(BOX, (left, top, right, bottom), strict=True)) | changes).items():
        if value is not None:
            setattr(area, name, value)
    return area


def write_dicom(
    path,
    images,
    regions=(),
    photometric="MONOCHROME2",
    **elements,
):
    """Write `images` (frame, row, column[, colour]) as a scanner does."""
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.sequence import Sequence
    from pydicom.uid import ExplicitVRLittleEndian, UltrasoundMultiFrameImageStorage, generate_uid

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = UltrasoundMultiFrameImageStorage
    meta.MediaStorageSOPInstanceUID = generate_uid(entropy_srcs=["speckle3d"])
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    file = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)
    file.SOPClassUID, file.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    file.Modality, file.Manufacturer, file.PatientName = "US", "Someone", "Doe^Jane"
    file.NumberOfFrames, file.Rows, file.Columns = images.shape[:3]
    file.SamplesPerPixel = images.shape[3] if images.ndim == 4 else 1
    if images.ndim == 4:
        file.PlanarConfiguration = 0
    file.PhotometricInterpretation = photometric
    file.BitsAllocated = file.BitsStored = 8 * images.itemsize
    file.HighBit, file.PixelRepresentation = 8 * images.itemsize - 1, 0
    if regions:
        file.SequenceOfUltrasoundRegions = Sequence(regions)
    for name, value in ({"FrameTime": 40.0} | elements).items():
        if value is not None:
            setattr(file, name, value)
    file.PixelData = images.tobytes()
    file.save_as(path, enforce_file_format=True)
    return path


def write_zea(path, frames, kind="beamformed_data", scan=()):
    """Write `frames` (frame, vector, sample) as zea 0.0.12 does."""
    values = frames.transpose(0, 2, 1)
    if kind == "beamformed_data":
        parts = (values.real, values.imag) if np.iscomplexobj(frames) else (values,)
        values = np.stack(parts, axis=-1).astype("f4")
    x, z = axes(*frames.shape[1:])
    positions = np.stack([*np.broadcast_arrays(x[None], 0.0, z[:, None])], axis=-1)
    fields = {"sound_speed": 1480.0, "center_frequency": 6e6, "demodulation_frequency": 6e6} | dict(scan)
    with h5py.File(path, "a") as file:
        file.attrs.update({"zea_version": "0.0.12", "probe_name": "L11-4v"})
        group = file.create_group(f"data/{kind}")
        group.create_dataset("values", data=values, compression="gzip", chunks=(1, *values.shape[1:]))
        group["coordinates"] = np.broadcast_to(positions, (len(frames), *positions.shape)).astype("f4")
        for name, value in fields.items():
            if value is not None:
                file[f"scan/{name}"] = np.asarray(value, "f4")
    return path


def carrying(frequency_hz, sound_speed=1480.0):
    """Complex echoes of a frequency, of a band a fifth of it, on the examples' grid."""
    rng = np.random.default_rng(0)
    white = rng.normal(size=(2, FRAMES, VECTORS, SAMPLES))
    smooth = np.apply_along_axis(np.convolve, 3, white, np.hanning(9), "same")
    turn = 2 * np.pi * frequency_hz * 2e-3 * SPACING_MM / sound_speed * np.arange(SAMPLES)
    return ((smooth[0] + 1j * smooth[1]) * np.exp(1j * turn)).astype(np.complex64)


def matlab_order(frames):
    """Frames (frame, vector, sample) as MATLAB holds them: (sample, vector, frame)."""
    return frames.transpose(2, 1, 0)


def write_mat(path, new=False, **variables):
    """Save variables as MATLAB does, dictionaries as structs, lists as cells; `new` is version 7.3."""
    if new:
        _write_mat_73(path, variables)
        return path
    from scipy.io import savemat

    savemat(path, {name: _old(value) for name, value in variables.items()}, do_compression=True)
    return path


def _old(value):
    if isinstance(value, dict):
        return {name: _old(element) for name, element in value.items()}
    if isinstance(value, list):
        cell = np.empty((1, len(value)), dtype=object)
        for i, element in enumerate(value):
            cell[0, i] = _old(element)
        return cell
    return value


def _write_mat_73(path, variables):
    """Write HDF5 behind 512 bytes, axes in reverse, complex numbers as pairs, cells as references."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            _put_73(file, file, name, value)
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124) + b"\0\2IM"
    with path.open("r+b") as stream:
        stream.write(head)


def _put_73(file, group, name, value):
    if isinstance(value, dict):
        child = group.create_group(name)
        child.attrs["MATLAB_class"] = np.bytes_("struct")
        for field, element in value.items():
            _put_73(file, child, field, element)
        return
    if isinstance(value, list):
        refs = file.require_group("#refs#")
        names = [f"r{len(refs) + i}" for i in range(len(value))]
        for ref, element in zip(names, value, strict=True):
            _put_73(file, refs, ref, element)
        data = np.array([[refs[ref].ref] for ref in names], dtype=h5py.ref_dtype)
        group.create_dataset(name, data=data).attrs["MATLAB_class"] = np.bytes_("cell")
        return
    values = np.array([list(map(ord, value))], "u2") if isinstance(value, str) else np.atleast_2d(value)
    kind = {"f8": "double", "f4": "single", "i2": "int16", "u1": "uint8"}.get(values.dtype.str[1:], "double")
    if isinstance(value, str):
        kind = "char"
    if np.iscomplexobj(values):
        part = values.real.dtype
        pairs = np.empty(values.shape, [("real", part), ("imag", part)])
        pairs["real"], pairs["imag"] = values.real, values.imag
        values, kind = pairs, "single"
    chunks = (1, *values.T.shape[1:]) if values.ndim > 2 else None
    node = group.create_dataset(name, data=values.T, chunks=chunks, compression="gzip" if chunks else None)
    node.attrs["MATLAB_class"] = np.bytes_(kind)
