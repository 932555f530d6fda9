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
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.wires import WirePhantom
from speckle3d.io.plus.device_set import device_set, read_xml, vector

_PATTERN_WIRES = {"NWire": 3, "CoplanarParallelWires": None}
"""How many wires a pattern of each type has."""


@dataclass(frozen=True)
class WireConfig:
    """What a device set says about a wire phantom and the images of it.

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
        Naming the element that is missing or wrong. A document with a type declaration is refused, because
        the entities it may declare can grow without bounds.
    """
    root = read_xml(path)
    with naming(str(path)):
        segmentation = root.find(".//Segmentation")
        return WireConfig(_phantom(path, root), *(() if segmentation is None else _hints(segmentation)))


def _phantom(path: PathLike, root: Element) -> WirePhantom:
    names: list[str] = []
    ends, patterns = [], []
    for number, pattern in enumerate(root.iterfind(".//PhantomDefinition/Geometry/Pattern")):
        kind, wires = pattern.get("Type", ""), pattern.findall("Wire")
        wanted = _PATTERN_WIRES.get(kind) or len(wires) or "some"
        if kind not in _PATTERN_WIRES or len(wires) != wanted:
            raise InvalidInputError(
                f"Pattern[{number}]: expected Type {' or '.join(_PATTERN_WIRES)} with {wanted} elements "
                f"Wire, got {kind!r} with {len(wires)}"
            )
        patterns.append(tuple(range(len(names), len(names) + len(wires))))
        for i, wire in enumerate(wires):
            names.append(wire.get("Name") or f"{number + 1}.{i + 1}")
            ends.append([vector(wire, f"EndPoint{end}", 3) for end in ("Front", "Back")])
    if not names:
        raise InvalidInputError("PhantomDefinition/Geometry: expected elements Pattern with wires, got none")
    pose = _phantom_pose(path, root)
    return WirePhantom(tuple(names), np.reshape(ends, (-1, 2, 3)), tuple(patterns), pose)


def _phantom_pose(path: PathLike, root: Element) -> RigidTransform | None:
    """Find the phantom in PLUS's reference frame, whichever way round the file has it."""
    algorithm = root.find(".//vtkPlusProbeCalibrationAlgo")
    named = {} if algorithm is None else algorithm.attrib
    phantom = named.get("PhantomCoordinateFrame", "Phantom")
    reference = named.get("ReferenceCoordinateFrame", "Reference")
    matrix = device_set(str(path), root).transform(phantom, reference)
    if matrix is None:
        return None
    pose: RigidTransform = transforms_from_matrices(matrix[None], f"{phantom} to {reference}")[0]
    return pose


def _hints(segmentation: Element) -> tuple[float | None, FloatArray | None]:
    """Size of a pixel and the part of images in which dots are looked for."""
    spacing, clip = None, None
    if "ApproximateSpacingMmPerPixel" in segmentation.attrib:
        (spacing,) = vector(segmentation, "ApproximateSpacingMmPerPixel", 1)
    if {"ClipRectangleOrigin", "ClipRectangleSize"} <= segmentation.attrib.keys():
        left, top = vector(segmentation, "ClipRectangleOrigin", 2)
        columns, rows = vector(segmentation, "ClipRectangleSize", 2)
        right, bottom = left + columns - 1, top + rows - 1
        clip = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    return spacing, clip
