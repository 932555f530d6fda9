"""Documents of PLUS: what a device set says about images, and what other documents are for.

A device set tells the place of the images on the probe, their pixels and their clip. A result of PLUS's probe
calibration, whose transforms are in ``CalibrationResults``, is read alike.

References
----------
.. [1] PLUS user manual, "Device set configuration", "Transformation matrix definition", "Volume
   reconstruction".
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike, open_regular
from speckle3d.core.grid import ImageGrid
from speckle3d.io.hdf5 import reading
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.transforms import Names, pixel_axes
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row
from speckle3d.io.text import numbers

_PLACES = (".//CoordinateDefinitions/Transform", ".//CalibrationResults/Transform")
_ALGORITHMS = (".//vtkPlusProbeCalibrationAlgo", ".//vtkProbeCalibrationAlgo", ".//fCal")
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
        If the file cannot be read.
    InvalidInputError
        If it is no XML, or has a type declaration: the entities it may declare can grow without bounds.
    """
    with reading(path), open_regular(path) as stream:
        text = stream.read()
    try:
        return ElementTree.fromstring(text, ElementTree.XMLParser(target=_PlainTree()))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InvalidInputError(f"{path}: expected well-formed XML, got: {error}") from error


class _PlainTree(ElementTree.TreeBuilder):
    """The tree of a document without a type declaration, so that it has no entities of its own."""

    def doctype(self, name: str, *_: object) -> None:
        raise ValueError(f"a document type declaration ({name})")


def vector(element: Element, attribute: str, count: int) -> tuple[float, ...]:
    """Read an attribute of `count` numbers."""
    label = element.get("Name") or element.get("From") or ""
    where = f"{element.tag}{f' {label}' if label else ''}: {attribute}"
    return numbers(element.get(attribute, ""), count, where)


@dataclass(frozen=True)
class Clip:
    """The part of the images that PLUS puts into volumes, in pixels of the standard orientation.

    Attributes
    ----------
    columns, rows : tuple of float, optional
        First and last.
    fan : tuple of float, optional
        Column and row of the apex, the radii, and the angles in degrees from straight down.
    """

    columns: tuple[float, float] | None = None
    rows: tuple[float, float] | None = None
    fan: tuple[float, float, float, float, float, float] | None = None

    def __str__(self) -> str:
        parts = []
        if self.columns is not None and self.rows is not None:
            parts.append("columns {:g} to {:g}, rows {:g} to {:g}".format(*self.columns, *self.rows))
        if self.fan is not None:
            parts.append(
                "fan about {:g}, {:g} from {:g} to {:g} pixels, {:g} to {:g} degrees".format(*self.fan)
            )
        return "; ".join(parts)

    def is_part_of(self, size: tuple[int, ...]) -> bool:
        """Whether something of images of a size (x, y) is left out."""
        sides = zip((self.columns, self.rows), size, strict=False)
        return self.fan is not None or any(
            side is not None and (side[0] > 0 or side[1] < length - 1) for side, length in sides
        )

    def region_text(self, grid: ImageGrid) -> str | None:
        """The part as a region of images in mm; None where it is all of them."""
        outlines = []
        if not self.is_part_of((grid.vectors, grid.samples)):
            return None
        if self.columns is not None and self.rows is not None:
            (left, right), (top, bottom) = np.add([self.columns, self.rows], [-_HAIR, _HAIR])
            outlines.append(np.array([(left, top), (right, top), (right, bottom), (left, bottom)]))
        if self.fan is not None:
            x, y, inner, outer, first, stop = self.fan
            angles = np.deg2rad(np.linspace(first, stop, _ARC_POINTS))
            arc = np.column_stack([np.sin(angles), np.cos(angles)])
            outline = np.concatenate([outer * arc, inner * arc[::-1]])
            # PLUS moves both halves a pixel towards the middle (vtkIGSIOPasteSliceIntoVolume).
            outline[:, 0] -= (1 - _HAIR) * np.sign(outline[:, 0])
            outlines.append(np.add(outline, [x, y]))
        parts = []
        for pixels in outlines:
            places = np.column_stack([pixels, np.ones(len(pixels))]) @ grid.image_from_sample[:2].T
            parts.append("polygon " + " ".join(f"{x:.6f},{y:.6f}" for x, y in places))
        return " and ".join(parts)


@dataclass(frozen=True)
class DeviceSet:
    """What a device set says; by default, what PLUS takes for granted.

    Attributes
    ----------
    names : Names
        Of the coordinate frames.
    origin_frame : str
        Frame of the transducer's face, in mm.
    transforms : dict
        Fixed transforms, shape (4, 4), by the frames from which and to which they lead.
    image_orientation : str, optional
        Of the machine's own images, as UF.
    probe : str
        Model of the transducer.
    geometry : str
        Of the transducer, as LINEAR; empty where the set does not say.
    width_mm : float, optional
        Of the transducer.
    radii_mm, angles_deg : tuple of float, optional
        First and last sample's distance from where the lines of a curved array meet, and its first and last
        line's angle from straight down.
    output_size, output_mm : tuple, optional
        Pixels along x and y of the image that PLUS makes of lines, and their distances.
    clip : Clip, optional
    """

    path: str = ""
    names: Names = field(default_factory=Names)
    origin_frame: str = "TransducerOrigin"
    transforms: dict[tuple[str, str], FloatArray] = field(default_factory=dict)
    image_orientation: str | None = None
    probe: str = ""
    geometry: str = ""
    width_mm: float | None = None
    radii_mm: tuple[float, float] | None = None
    angles_deg: tuple[float, float] | None = None
    output_size: tuple[float, ...] | None = None
    output_mm: tuple[float, ...] | None = None
    clip: Clip | None = None

    @property
    def is_curved(self) -> bool:
        """Whether the transducer's lines spread."""
        return self.geometry not in ("", "LINEAR")

    def transform(self, start: str, end: str) -> FloatArray | None:
        """Product of the transforms, or their inverses, on the shortest way between two frames, if any."""
        reached, waiting = {start: np.eye(4)}, [start]
        for place in waiting:
            for (a, b), matrix in self.transforms.items():
                target = b if a == place else a
                if place in (a, b) and target not in reached:
                    reached[target] = (matrix if a == place else np.linalg.inv(matrix)) @ reached[place]
                    waiting.append(target)
        return reached.get(end)

    def pixel_mm(self, size: tuple[float, ...] | None) -> tuple[float, ...] | None:
        """Distances of columns and rows of the image, whose size is (x, y), mm; None if unknown."""
        for end in (self.names.probe, self.origin_frame):
            if (matrix := self.transform(self.names.image, end)) is not None:
                return pixel_axes(matrix, f"{self.path}: {self.names.image} to {end}")
        is_of_size = self.output_size is None or (size is not None and tuple(size[:2]) == self.output_size)
        return self.output_mm if is_of_size else None


def read_device_set(path: PathLike) -> DeviceSet:
    """Read a device set, or the result of a probe calibration.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the element that is wrong, or if the document is another.
    """
    root = read_xml(path)
    if root.tag not in [*_DOCUMENTS][:2]:
        raise InvalidInputError(
            f"{path}: expected a device set of PLUS (PlusConfiguration), or a ProbeCalibrationResult, "
            f"got {root.tag}"
        )
    with naming(str(path)):
        return device_set(str(path), root)


def device_set(path: str, root: Element) -> DeviceSet:
    """What a document says, its first element being `root`."""
    usual, named = Names(), dict[str, str]()
    for place in _ALGORITHMS:
        for element in root.iterfind(place):
            named |= element.attrib
    scan = root.find(".//ScanConversion")
    scan = Element("none") if scan is None else scan
    width = _values(scan, 1, "TransducerWidthMm")
    return DeviceSet(
        path,
        Names(
            named.get("ImageCoordinateFrame", usual.image),
            named.get("ProbeCoordinateFrame", usual.probe),
            _attribute(root, "ToolReferenceFrame") or usual.tracker,
        ),
        named.get("TransducerOriginCoordinateFrame", "TransducerOrigin"),
        {
            (one.get("From", ""), one.get("To", "")): np.reshape(vector(one, "Matrix", 16), (4, 4))
            for place in _PLACES
            for one in root.iterfind(place)
        },
        _attribute(root, "PortUsImageOrientation"),
        scan.get("TransducerName", ""),
        scan.get("TransducerGeometry", "").upper(),
        None if width is None else width[0],
        _both(scan, "RadiusStartMm", "RadiusStopMm"),
        _both(scan, "ThetaStartDeg", "ThetaStopDeg"),
        _values(scan, 2, "OutputImageSizePixel"),
        _values(scan, 2, "OutputImageSpacingMmPerPixel"),
        _clip(root.find(".//VolumeReconstruction")),
    )


def _both(element: Element, *names: str) -> tuple[float, float] | None:
    """Two numbers, if both are there."""
    first, last = (_values(element, 1, name) for name in names)
    return None if first is None or last is None else (first[0], last[0])


def _clip(element: Element | None) -> Clip | None:
    """Clip and fan of a volume reconstruction; names without a unit are those of older versions [1]_."""
    if element is None:
        return None
    origin, size = _values(element, 2, "ClipRectangleOrigin"), _values(element, 2, "ClipRectangleSize")
    columns = rows = None
    if origin is not None and size is not None and min(size) > 0:
        # PLUS counts the pixel behind the rectangle, too (vtkIGSIOPasteSliceIntoVolume).
        columns, rows = ((first, first + count) for first, count in zip(origin, size, strict=True))
    angles = _values(element, 2, "FanAnglesDeg", "FanAngles")
    apex = _values(element, 2, "FanOriginPixel", "FanOrigin")
    outer = _values(element, 1, "FanRadiusStopPixel", "FanDepth")
    inner = _values(element, 1, "FanRadiusStartPixel", "FanRadiusStart") or (0.0,)
    fan = None
    if angles is not None and apex is not None and outer is not None and angles[0] != angles[1]:
        fan = (apex[0], apex[1], inner[0], outer[0], min(angles), max(angles))
    return None if columns is None and fan is None else Clip(columns, rows, fan)


def _values(element: Element, count: int, *names: str) -> tuple[float, ...] | None:
    """Numbers of the first of some attributes that there is."""
    return next((vector(element, name, count) for name in names if name in element.attrib), None)


def _attribute(root: Element, name: str) -> str | None:
    """Value of an attribute that all elements with it share; None where none has it, or they differ."""
    values = {element.get(name) for element in root.iter() if name in element.attrib}
    return values.pop() if len(values) == 1 else None


def _open(path: Path, settings: ImportSettings) -> Recording:
    root = read_xml(path)
    if root.tag not in _DOCUMENTS:
        raise InvalidInputError(
            f"{path}: expected a document of PLUS ({', '.join(_DOCUMENTS)}), got {root.tag}"
        )
    what, use = _DOCUMENTS[root.tag]
    rows: list[Row] = [("content", what, "")]
    if root.tag == "TemporalCalibrationResults":  # whose sign is the other way round: a lag is negative there
        rows.append(("time offset of the tracker", f"{-vector(root, 'TrackerLagSec', 1)[0]:+.4f}", "s"))
    if use == _CONFIG:
        device = read_device_set(path)
        pixel = device.pixel_mm(device.output_size)
        if root.find(".//PhantomDefinition/Geometry/Pattern/Wire") is not None:
            use += ", --phantom of calibrate wires"
        rows += [
            *((f"{a} to {b}", "transform", "") for a, b in device.transforms),
            ("pixel", "unknown" if pixel is None else " x ".join(f"{mm:.5f} mm" for mm in pixel), ""),
            ("transducer", f"{device.probe} {device.geometry}".strip() or "not said", ""),
            ("clip of volumes", "none" if device.clip is None else str(device.clip), ""),
        ]
    fault = InvalidInputError(f"{path}: expected a recording, got {what} of PLUS, which is for {use}")
    return Recording(path, settings, rows=(*rows, ("for", use, "")), fault=fault)


def _claims(_: Path, start: bytes) -> bool:
    return start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<") and any(
        f"<{name}".encode() in start for name in _DOCUMENTS
    )


READER = Reader("PLUS document", _claims, _open)
