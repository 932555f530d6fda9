"""XML documents of PLUS: device sets, and recognition of other documents.

A device set tells the place of the images on the probe, their pixels and their clip. A result of PLUS's probe
calibration, whose transforms are in ``CalibrationResults``, is read alike.

References
----------
.. [1] PLUS user manual, "Device set configuration", "Transformation matrix definition", "Volume
   reconstruction".
"""

from dataclasses import dataclass, field
from functools import cached_property, partial, reduce
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.core.grid import ImageGrid
from speckle3d.core.wires import WirePhantom
from speckle3d.io.hdf5 import reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.transforms import IMAGE, PROBE, chain_between, pixel_axes
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Facts
from speckle3d.io.text import numbers

_PLACES = (".//CoordinateDefinitions/Transform", ".//CalibrationResults/Transform")
_HAIR = 0.1
"""Pixels by which a rectangle is wider, so that rounding loses none of its own."""
_ARC_POINTS = 128
"""Of a fan's arc in a polygon: 0.02 pixels off the circle at a radius of 1,000 pixels and 90 degrees."""
_CONFIG = "--plus-config of convert"
_DOCUMENTS = {
    "PlusConfiguration": ("a device set", _CONFIG),
    "ProbeCalibrationResult": ("the result of a probe calibration", _CONFIG),
    "TemporalCalibrationResults": ("a tracker's delay", "--time-offset-s of calibrate"),
    "LineSegmentationResults": ("lines found in images", "comparison alone, as lines are found anew"),
}
"""What a document is, and what for, by its first element."""


def read_xml(path: PathLike) -> Element:
    """Read a document's first element.

    Raises
    ------
    FileError
        If the file cannot be read, or is no XML.
    """
    with reading(f"{path}: as XML", ElementTree.ParseError, LookupError), open_regular(path) as stream:
        return ElementTree.parse(stream).getroot()


def vector(element: Element, attribute: str, count: int) -> tuple[float, ...]:
    """Read an attribute of `count` numbers."""
    return numbers(element.get(attribute, ""), count, f"{element.tag}: {attribute}")


@dataclass(frozen=True)
class DeviceSet:
    """Contents of a device set; by default, PLUS's own defaults.

    Attributes
    ----------
    root : Element
        First element of the document.
    """

    path: str = ""
    root: Element = field(default_factory=lambda: Element("PlusConfiguration"))

    def numbers(self, tag: str, count: int, *names: str) -> tuple[float, ...] | None:
        """Numbers of the first of some attributes that an element of a tag has."""
        for element in self.root.iterfind(f".//{tag}"):
            for name in names:
                if name in element.attrib:
                    with naming(self.path):
                        return vector(element, name, count)
        return None

    def text(self, name: str, default: str = "") -> str:
        """An attribute that all elements with it share; the default where none has it, or they differ."""
        values = {element.attrib[name] for element in self.root.iter() if name in element.attrib}
        return values.pop() if len(values) == 1 else default

    @property
    def image(self) -> str:
        """Name of the image's frame."""
        return self.text("ImageCoordinateFrame", IMAGE)

    @property
    def probe(self) -> str:
        """Name of the probe's frame."""
        return self.text("ProbeCoordinateFrame", PROBE)

    @cached_property
    def transforms(self) -> dict[tuple[str, str], FloatArray]:
        """Fixed transforms, shape (4, 4), by the frames from which and to which they lead."""
        with naming(self.path):
            return {
                (element.get("From", ""), element.get("To", "")): np.reshape(
                    vector(element, "Matrix", 16), (4, 4)
                )
                for place in _PLACES
                for element in self.root.iterfind(place)
            }

    @property
    def geometry(self) -> str:
        """Geometry of the transducer, as LINEAR; empty where the set does not say."""
        return self.text("TransducerGeometry").upper()

    @property
    def is_curved(self) -> bool:
        """Whether the transducer's lines spread."""
        return self.geometry not in ("", "LINEAR")

    def scan(self, *names: str) -> tuple[float, ...] | None:
        """Numbers by which the machine makes an image of lines, if all are there."""
        values = [self.numbers("ScanConversion", 1, name) or () for name in names]
        return sum(values, ()) if all(values) else None

    def clip_region(self, grid: ImageGrid) -> str | None:
        """Clip and fan of a volume reconstruction as a region of images in mm; None where it is all of them.

        Names without a unit are those of older versions [1]_.
        """
        region, outlines = partial(self.numbers, "VolumeReconstruction"), list[FloatArray]()
        corner, size = region(2, "ClipRectangleOrigin"), region(2, "ClipRectangleSize")
        if corner and size and min(size) > 0:
            # PLUS counts the pixel behind the rectangle, too (vtkIGSIOPasteSliceIntoVolume).
            (left, top), (right, bottom) = np.subtract(corner, _HAIR), np.add(corner, size) + _HAIR
            if max(left, top, grid.vectors - 1 - right, grid.samples - 1 - bottom) > 0:
                outlines.append(np.array([(left, top), (right, top), (right, bottom), (left, bottom)]))
        angles, apex = region(2, "FanAnglesDeg", "FanAngles"), region(2, "FanOriginPixel", "FanOrigin")
        outer = region(1, "FanRadiusStopPixel", "FanDepth")
        if angles and apex and outer and angles[0] != angles[1]:
            inner = region(1, "FanRadiusStartPixel", "FanRadiusStart") or (0.0,)
            turns = np.deg2rad(np.linspace(min(angles), max(angles), _ARC_POINTS))
            arc = np.column_stack([np.sin(turns), np.cos(turns)])
            outline = np.concatenate([outer * arc, inner * arc[::-1]])
            # PLUS moves both halves a pixel towards the middle.
            outline[:, 0] -= (1 - _HAIR) * np.sign(outline[:, 0])
            outlines.append(apex + outline)
        texts = (" ".join(f"{x:.6f},{y:.6f}" for x, y in grid.mm(*outline.T)) for outline in outlines)
        return " and ".join(f"polygon {text}" for text in texts) or None

    def transform(self, start: str, end: str) -> FloatArray | None:
        """Product of the transforms, or their inverses, on the shortest way between two frames, if any."""
        if (chain := chain_between(self.transforms, start, end)) is None:
            return None
        parts = self.transforms | {(b, a): np.linalg.inv(m) for (a, b), m in self.transforms.items()}
        return reduce(lambda product, pair: parts[pair] @ product, chain, np.eye(4))

    def pixel_mm(self, size: tuple[float, ...] | None = None) -> tuple[float, ...] | None:
        """Distances of columns and rows of the image, by default the machine's, mm; None if unknown."""
        for end in (self.probe, self.text("TransducerOriginCoordinateFrame", "TransducerOrigin")):
            if (matrix := self.transform(self.image, end)) is not None:
                return pixel_axes(matrix, f"{self.path}: {self.image} to {end}")
        machine_size = self.numbers("ScanConversion", 2, "OutputImageSizePixel")
        is_of_size = machine_size is None or size is None or size[:2] == machine_size
        return self.numbers("ScanConversion", 2, "OutputImageSpacingMmPerPixel") if is_of_size else None


def read_device_set(path: PathLike) -> DeviceSet:
    """Read a device set, or the result of a probe calibration.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If the document is another; what is wrong in it is told when it is asked for.
    """
    root = read_xml(path)
    if root.tag not in [*_DOCUMENTS][:2]:
        raise InvalidInputError(
            f"{path}: expected a device set of PLUS (PlusConfiguration), or a ProbeCalibrationResult, "
            f"got {root.tag}"
        )
    return DeviceSet(str(path), root)


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


def _open(path: Path, _: ImportSettings) -> Facts:
    """Describe a document; it holds no sweep."""
    device = DeviceSet(str(path), read_xml(path))
    root, pixel = device.root, device.pixel_mm()
    content, use = _DOCUMENTS.get(root.tag, (root.tag, "nothing here"))
    yield "content", content, ""
    if root.tag == "TemporalCalibrationResults":  # whose sign is the other way round: a lag is negative there
        yield "time offset of the tracker", f"{-vector(root, 'TrackerLagSec', 1)[0]:+.4f}", "s"
    if pixel is not None:
        yield "pixel", " x ".join(f"{mm:.5f} mm" for mm in pixel), ""
    if device.transforms:
        yield "transforms", ", ".join(f"{a}To{b}" for a, b in device.transforms), ""
    if name := device.text("TransducerName"):
        yield "transducer", f"{name} {device.geometry}".strip(), ""
    if root.find(".//PhantomDefinition/Geometry/Pattern/Wire") is not None:
        use += ", --phantom of calibrate wires"
    yield "for", use, ""
    raise InvalidInputError(f"{path}: expected a recording, got {content} of PLUS, which is for {use}")


def _claims(_: Path, start: bytes) -> bool:
    return start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<") and any(
        f"<{name}".encode() in start for name in _DOCUMENTS
    )


READER = Reader("PLUS document", _claims, _open)
