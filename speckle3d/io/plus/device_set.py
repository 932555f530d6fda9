"""What a device set of PLUS says about images: their place on the probe, their pixels, their clip.

A result of PLUS's probe calibration, whose transforms are in ``CalibrationResults``, is read alike.

References
----------
.. [1] PLUS user manual, "Device set configuration", "Transformation matrix definition", "Volume
   reconstruction".
"""

from __future__ import annotations

from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.sweep import ImageGrid
from speckle3d.io.plus.transforms import Names, pixel_axes
from speckle3d.io.plus.xml import read_xml, vector

_PLACES = (".//CoordinateDefinitions/Transform", ".//CalibrationResults/Transform")
_INVERSE_TOLERANCE = 0.1
"""How far the product of a transform and its inverse, both of some digits, may be from the identity, mm or
pixels."""
_ALGORITHMS = (".//vtkPlusProbeCalibrationAlgo", ".//vtkProbeCalibrationAlgo", ".//fCal")
_HAIR = 0.1
"""Pixels by which a rectangle is wider, so that rounding loses none of its own."""
_ARC_POINTS = 128
"""Of a fan's arc in a polygon: 0.02 pixels off the circle at a radius of 1,000 pixels and 90 degrees."""


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
class ScanConversion:
    """How PLUS makes an image of lines.

    Attributes
    ----------
    probe : str
        Model of the transducer.
    geometry : str
        Of the transducer, as LINEAR; empty where the set does not say.
    width_mm : float, optional
        Of the transducer.
    output_size, output_mm : tuple, optional
        Pixels along x and y of the image, and their distances.
    """

    probe: str = ""
    geometry: str = ""
    width_mm: float | None = None
    output_size: tuple[float, ...] | None = None
    output_mm: tuple[float, float] | None = None

    @property
    def is_curved(self) -> bool:
        """Whether the transducer's lines spread."""
        return self.geometry not in ("", "LINEAR")


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
    scan : ScanConversion
    clip : Clip, optional
    """

    path: str = ""
    names: Names = field(default_factory=Names)
    origin_frame: str = "TransducerOrigin"
    transforms: dict[tuple[str, str], FloatArray] = field(default_factory=dict)
    image_orientation: str | None = None
    scan: ScanConversion = ScanConversion()
    clip: Clip | None = None

    def transform(self, start: str, end: str) -> FloatArray | None:
        """Product of the transforms, or their inverses, on the shortest way between two frames, if any.

        Raises
        ------
        InvalidInputError
            If a transform on the way that is needed the other way round has no inverse.
        """
        reached, waiting = {start: np.eye(4)}, [start]
        for place in waiting:
            for (a, b), matrix in self.transforms.items():
                target = b if a == place else a
                if place not in (a, b) or target in reached:
                    continue
                if b == place and not np.linalg.det(matrix):
                    where = f"{self.path}: Transform {a} to {b}"
                    raise InvalidInputError(f"{where}: expected a matrix with an inverse, got a singular one")
                reached[target] = (matrix if a == place else np.linalg.inv(matrix)) @ reached[place]
                waiting.append(target)
        return reached.get(end)

    def pixel_mm(self, size: tuple[float, ...] | None) -> tuple[float, float] | None:
        """Distances of columns and rows of the image, whose size is (x, y), mm; None if unknown."""
        for end in (self.names.probe, self.origin_frame):
            if (matrix := self.transform(self.names.image, end)) is not None:
                return pixel_axes(matrix, f"{self.path}: {self.names.image} to {end}")
        made = self.scan.output_size
        is_of_size = made is None or (size is not None and tuple(size[:2]) == made)
        return self.scan.output_mm if is_of_size else None


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
    if root.tag not in ("PlusConfiguration", "ProbeCalibrationResult"):
        raise InvalidInputError(
            f"{path}: expected a device set of PLUS (PlusConfiguration), or a ProbeCalibrationResult, "
            f"got {root.tag}"
        )
    with naming(str(path)):
        usual, named = Names(), dict[str, str]()
        for place in _ALGORITHMS:
            for element in root.iterfind(place):
                named |= element.attrib
        return DeviceSet(
            str(path),
            Names(
                named.get("ImageCoordinateFrame", usual.image),
                named.get("ProbeCoordinateFrame", usual.probe),
                _attribute(root, "ToolReferenceFrame") or usual.tracker,
            ),
            named.get("TransducerOriginCoordinateFrame", "TransducerOrigin"),
            _transforms(root),
            _attribute(root, "PortUsImageOrientation"),
            _scan_conversion(root.find(".//ScanConversion")),
            _clip(root.find(".//VolumeReconstruction")),
        )


def _transforms(root: Element) -> dict[tuple[str, str], FloatArray]:
    """Transforms by their ends; what is said twice, or both ways round, must be said alike."""
    transforms: dict[tuple[str, str], FloatArray] = {}
    for element in (one for place in _PLACES for one in root.iterfind(place)):
        a, b = element.get("From", ""), element.get("To", "")
        matrix = np.reshape(vector(element, "Matrix", 16), (4, 4))
        same, back = transforms.get((a, b), matrix), transforms.get((b, a))
        is_inverse = back is None or np.allclose(back @ matrix, np.eye(4), 0, _INVERSE_TOLERANCE)
        if not np.array_equal(same, matrix) or not is_inverse:
            expected = f"the inverse of From={b} To={a}, " if is_inverse is False else ""
            other = same if is_inverse or back is None else back
            raise InvalidInputError(
                f"Transform From={a} To={b}: expected {expected}what is said of it before, {_text(other)}, "
                f"got {_text(matrix)}"
            )
        transforms[a, b] = matrix
    return transforms


def _text(matrix: FloatArray) -> str:
    return " ".join(f"{value:g}" for value in matrix.ravel())


def _scan_conversion(element: Element | None) -> ScanConversion:
    if element is None:
        return ScanConversion()
    width = _values(element, 1, "TransducerWidthMm")
    spacing = _values(element, 2, "OutputImageSpacingMmPerPixel")
    size = _values(element, 2, "OutputImageSizePixel")
    if min((*(width or ()), *(spacing or ()), *(size or ())), default=1.0) <= 0:
        raise InvalidInputError("ScanConversion: width, spacing and size: expected above zero, got others")
    return ScanConversion(
        element.get("TransducerName", ""),
        element.get("TransducerGeometry", "").upper(),
        None if width is None else width[0],
        size,
        None if spacing is None else (spacing[0], spacing[1]),
    )


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
