"""Small image sequences written as PLUS writes them."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

TYPES = {"uint8": "MET_UCHAR", "int16": "MET_SHORT", "int32": "MET_INT", "float32": "MET_FLOAT"}


def text_of(matrix):
    return " ".join(f"{value:.6g}" for value in np.ravel(matrix))


def write_mha(path, pixels, fields=(), frames=None, spacing="1 1 1"):
    """Write pixels (frame, y, x) as PLUS does; `frames` are the fields of each frame."""
    if frames is None:
        frames = [{"Timestamp": f"{5.0 + 0.1 * i:.6f}", "ImageStatus": "OK"} for i in range(len(pixels))]
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CompressedData = False",
        f"DimSize = {pixels.shape[2]} {pixels.shape[1]} {pixels.shape[0]}   ",
        f"ElementSpacing = {spacing}",
        f"ElementType = {TYPES[pixels.dtype.name]}",
        *(f"{name} = {value}" for name, value in dict(fields).items()),
        *(f"Seq_Frame{i:04d}_{n} = {v}" for i, frame in enumerate(frames) for n, v in frame.items()),
        "ElementDataFile = LOCAL\n",
    ]
    path.write_bytes("\n".join(lines).encode() + pixels.tobytes())
    return path


def grey(frames=3, rows=4, columns=5):
    return np.random.default_rng(0).integers(0, 256, (frames, rows, columns)).astype(np.uint8)


def frame_fields(n, **fields):
    rng = np.random.default_rng(1)
    probe = RigidTransform.from_components(rng.normal(0, 100, (n, 3)), Rotation.random(n, rng=rng))
    reference = RigidTransform.from_components(rng.normal(0, 100, (n, 3)), Rotation.random(n, rng=rng))
    frames = [
        {
            "Timestamp": f"{5 + 0.1 * i:.6f}",
            "ProbeToTrackerTransform": text_of(probe[i].as_matrix()),
            "ProbeToTrackerTransformStatus": "OK",
            "ReferenceToTrackerTransform": text_of(reference[i].as_matrix()),
            "ReferenceToTrackerTransformStatus": "OK",
            **fields,
        }
        for i in range(n)
    ]
    return probe, reference, frames
