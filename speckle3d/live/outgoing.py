"""Poses, volumes and words as messages that PLUS's clients and 3D Slicer understand: RAS, mm."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.volume import Volume
from speckle3d.io.igtl.messages import packed_image, packed_status, packed_text, packed_transform
from speckle3d.io.images.headers import RAS_FROM_LPS

POSE, VOLUME, ADVICE = "ImageToReference", "Volume_Reference", "SweepAdvice"
"""Devices: pixels of the received images to the first image's mm, as PLUS names it; the growing volume in the
same; words."""
_NOT_READY = 13
"""OpenIGTLink's code of a device that is not ready."""


def pose_message(world_from_image: RigidTransform, image_from_pixel: FloatArray, time_s: float) -> bytes:
    """TRANSFORM from a received image's pixels (column, row, slice) to the world, at the image's own time."""
    matrix = RAS_FROM_LPS @ world_from_image.as_matrix() @ image_from_pixel
    return packed_transform(POSE, time_s, np.asarray(matrix))


def volume_message(volume: Volume, time_s: float) -> bytes:
    """IMAGE of a volume."""
    matrix = np.asarray(RAS_FROM_LPS @ volume.world_from_index)
    return packed_image(VOLUME, time_s, volume.voxels, matrix)


def word_messages(words: str, good: bool, time_s: float) -> tuple[bytes, bytes]:
    """STRING with words for the person who holds the probe, and STATUS: code 1 if all is well, else 13."""
    return packed_text(ADVICE, time_s, words), packed_status(ADVICE, time_s, words, 1 if good else _NOT_READY)
