"""Wire phantoms as PLUS describes them: the XML file of a device set.

The points and rectangles in PLUS's files count pixels of the image after PLUS turned it to its standard
orientation, columns to the marked side and rows away from the probe; so do the frames of `load_sweep`,
whatever the orientation in the image file, and no mapping is needed: column is vector and row is sample.

References
----------
.. [1] A. Lasso et al., "PLUS: open-source toolkit for ultrasound-guided intervention systems", IEEE Trans.
   Biomed. Eng. 61, 2014.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.wires import WirePhantom
from speckle3d.io.plus.device_set import DeviceSet, read_xml, vector

_PATTERNS = ("NWire", "CoplanarParallelWires")


@dataclass(frozen=True)
class WireConfig:
    """Wire phantom of a device set, with the pixel size of its images.

    Attributes
    ----------
    phantom : WirePhantom
        With ``world_from_phantom`` where the file holds it; the world is PLUS's reference frame.
    pixel_mm : float, optional
        Roughly, as somebody read it off the machine.
    clip_px : ndarray, shape (4, 2), optional
        The part of an image in which dots are looked for: column and row of the centres of its corner pixels,
        clockwise from the top left.
    """

    phantom: WirePhantom
    pixel_mm: float | None = None
    clip_px: FloatArray | None = None


def read_wire_phantom(path: PathLike) -> WireConfig:
    """Read a wire phantom from a device set of PLUS.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the element that is missing or wrong.
    """
    device = DeviceSet(str(path), read_xml(path))
    with naming(device.path):
        spacing, clip = device.numbers("Segmentation", 1, "ApproximateSpacingMmPerPixel"), None
        corner = device.numbers("Segmentation", 2, "ClipRectangleOrigin")
        size = device.numbers("Segmentation", 2, "ClipRectangleSize")
        if corner is not None and size is not None:
            (left, top), (right, bottom) = corner, np.add(corner, size) - 1
            clip = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        return WireConfig(_phantom(device), None if spacing is None else spacing[0], clip)


def _phantom(device: DeviceSet) -> WirePhantom:
    names, ends, patterns = list[str](), [], []
    for number, pattern in enumerate(device.root.iterfind(".//PhantomDefinition/Geometry/Pattern")):
        kind, wires = pattern.get("Type", ""), pattern.findall("Wire")
        if kind not in _PATTERNS or (kind == "NWire" and len(wires) != 3):
            raise InvalidInputError(
                f"Pattern[{number}]: expected an NWire of three elements Wire, or CoplanarParallelWires, got "
                f"{kind!r} with {len(wires)}"
            )
        patterns.append(tuple(range(len(names), len(names) + len(wires))))
        for i, wire in enumerate(wires):
            names.append(wire.get("Name") or f"{number + 1}.{i + 1}")
            ends.append([vector(wire, f"EndPoint{end}", 3) for end in ("Front", "Back")])
    if not names:
        raise InvalidInputError("PhantomDefinition/Geometry: expected elements Pattern with wires, got none")
    phantom = device.text("PhantomCoordinateFrame", "Phantom")
    reference = device.text("ReferenceCoordinateFrame", "Reference")
    matrix, pose = device.transform(phantom, reference), None
    if matrix is not None:
        pose = transforms_from_matrices(matrix[None], f"{phantom} to {reference}")[0]
    return WirePhantom(tuple(names), np.reshape(ends, (-1, 2, 3)), tuple(patterns), pose)
