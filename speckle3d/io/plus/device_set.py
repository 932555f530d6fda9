"""What a device set of PLUS says about images: where they are on the probe, and how large their pixels are.

A result of PLUS's probe calibration, whose transforms are in ``CalibrationResults``, is read alike.

References
----------
.. [1] PLUS user manual, "Device set configuration", "Transformation matrix definition".
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.files import PathLike
from speckle3d.io.plus.transforms import pixel_axes
from speckle3d.io.plus.xml import read_xml, vector

_PLACES = (".//CoordinateDefinitions/Transform", ".//CalibrationResults/Transform")
_INVERSE_TOLERANCE = 0.1
"""How far the product of a transform and its inverse, both of some digits, may be from the identity, mm or
pixels."""
_ALGORITHMS = (".//vtkPlusProbeCalibrationAlgo", ".//vtkProbeCalibrationAlgo", ".//fCal")


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


@dataclass(frozen=True)
class DeviceSet:
    """What a device set says; by default, what PLUS takes for granted.

    Attributes
    ----------
    image_frame, probe_frame, tracker_frame : str
        Names of the coordinate frames.
    origin_frame : str
        Frame of the transducer's face, in mm.
    transforms : dict
        Fixed transforms, shape (4, 4), by the frames from which and to which they lead.
    image_orientation : str, optional
        Of the machine's own images, as UF.
    scan : ScanConversion
    """

    path: str = ""
    image_frame: str = "Image"
    probe_frame: str = "Probe"
    tracker_frame: str = "Tracker"
    origin_frame: str = "TransducerOrigin"
    transforms: dict[tuple[str, str], FloatArray] = field(default_factory=dict)
    image_orientation: str | None = None
    scan: ScanConversion = ScanConversion()

    def transform(self, start: str, end: str) -> FloatArray | None:
        """Product of the transforms, or their inverses, on the shortest way between two frames, if any.

        Raises
        ------
        InvalidInputError
            If a transform on the way that is needed the other way round has no inverse.
        """
        start = self.image_frame if start == "Image" else start
        reached: dict[str, FloatArray] = {start: np.eye(4)}
        waiting = deque([start])
        while waiting and end not in reached:
            here = waiting.popleft()
            for (a, b), matrix in self.transforms.items():
                for source, target, inverted in ((a, b, False), (b, a, True)):
                    if source == here and target not in reached:
                        step = _inverse(matrix, f"{self.path}: Transform {a} to {b}") if inverted else matrix
                        reached[target] = step @ reached[here]
                        waiting.append(target)
        return reached.get(end)

    def pixel_mm(self, size: tuple[float, ...] | None) -> tuple[float, float] | None:
        """Distances of columns and rows of the image, whose size is (x, y), mm; None if unknown."""
        for end in (self.probe_frame, self.origin_frame):
            found = self.transform(self.image_frame, end)
            if found is not None:
                return pixel_axes(found, f"{self.path}: {self.image_frame} to {end}")
        made = self.scan.output_size
        is_of_size = made is None or (size is not None and tuple(size[:2]) == made)
        return self.scan.output_mm if is_of_size else None

    def line_pitch_mm(self, path: PathLike, lines: int) -> float | None:
        """Distance between the lines of which PLUS makes an image: the transducer's width over their number.

        Raises
        ------
        InvalidInputError
            If the transducer is curved, so that its lines are not parallel.
        """
        scan = self.scan
        if scan.geometry not in ("", "LINEAR"):
            raise InvalidInputError(
                f"{path}: expected lines of a linear transducer, got a {scan.geometry.lower()} one, whose "
                "lines spread, by the device set: give its scan-converted B-mode, or parallel lines"
            )
        return None if scan.width_mm is None else scan.width_mm / lines


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
        usual = DeviceSet()
        named: dict[str, str] = {}
        for place in _ALGORITHMS:
            for each in root.iterfind(place):
                named |= each.attrib
        return DeviceSet(
            path=str(path),
            image_frame=named.get("ImageCoordinateFrame", usual.image_frame),
            probe_frame=named.get("ProbeCoordinateFrame", usual.probe_frame),
            tracker_frame=_attribute(root, "ToolReferenceFrame") or usual.tracker_frame,
            origin_frame=named.get("TransducerOriginCoordinateFrame", usual.origin_frame),
            transforms=_transforms(root),
            image_orientation=_attribute(root, "PortUsImageOrientation"),
            scan=_scan_conversion(root.find(".//ScanConversion")),
        )


def _transforms(root: Element) -> dict[tuple[str, str], FloatArray]:
    """Transforms by their ends; what is said twice, or both ways round, must be said alike."""
    found: dict[tuple[str, str], FloatArray] = {}
    for place in _PLACES:
        for each in root.iterfind(place):
            a, b = each.get("From", ""), each.get("To", "")
            matrix = np.reshape(vector(each, "Matrix", 16), (4, 4))
            if (a, b) in found and not np.array_equal(found[a, b], matrix):
                raise InvalidInputError(
                    f"Transform From={a} To={b}: expected one, or the same again, got two: "
                    f"{_text(found[a, b])} and {_text(matrix)}"
                )
            back = found.get((b, a))
            if back is not None and not np.allclose(
                back @ matrix, np.eye(4), rtol=0, atol=_INVERSE_TOLERANCE
            ):
                raise InvalidInputError(
                    f"Transform From={a} To={b}: expected the inverse of From={b} To={a}, got another: "
                    f"{_text(matrix)} and {_text(back)}"
                )
            found[a, b] = matrix
    return found


def _text(matrix: FloatArray) -> str:
    return "[" + " ".join(f"{value:g}" for value in matrix.ravel()) + "]"


def _scan_conversion(element: Element | None) -> ScanConversion:
    if element is None:
        return ScanConversion()
    width = _positive(element, "TransducerWidthMm", 1)
    spacing = _positive(element, "OutputImageSpacingMmPerPixel", 2)
    return ScanConversion(
        element.get("TransducerName", ""),
        element.get("TransducerGeometry", "").upper(),
        None if width is None else width[0],
        _positive(element, "OutputImageSizePixel", 2),
        None if spacing is None else (spacing[0], spacing[1]),
    )


def _positive(element: Element, attribute: str, count: int) -> tuple[float, ...] | None:
    if attribute not in element.attrib:
        return None
    values = vector(element, attribute, count)
    if min(values) <= 0:
        raise InvalidInputError(f"ScanConversion: {attribute}: expected above zero, got {values}")
    return values


def _attribute(root: Element, name: str) -> str | None:
    """Value of an attribute that all elements with it share; None where none has it, or they differ."""
    values = {each.get(name) for each in root.iter() if name in each.attrib}
    return values.pop() if len(values) == 1 else None


def _inverse(matrix: FloatArray, where: str) -> FloatArray:
    try:
        return np.asarray(np.linalg.inv(matrix))
    except np.linalg.LinAlgError as error:
        raise InvalidInputError(f"{where}: expected a matrix with an inverse, got a singular one") from error
