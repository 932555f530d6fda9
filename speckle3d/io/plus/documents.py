"""XML documents of PLUS as recordings: told what they are, and which option takes them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.plus.device_set import read_device_set
from speckle3d.io.plus.xml import read_xml, vector
from speckle3d.io.readers import Reader
from speckle3d.io.recordings import Recording, Row


def _device_rows(path: Path, root: Element) -> list[Row]:
    device = read_device_set(path)
    pixel = device.pixel_mm(device.scan.output_size)
    devices = [
        f"{element.get('Id', 'one without a name')} ({element.get('Type')})".removesuffix(" (None)")
        for element in root.iterfind(".//Device")
    ]
    wires = len(root.findall(".//PhantomDefinition/Geometry/Pattern/Wire"))
    return [
        ("devices", ", ".join(devices) or "none", ""),
        *((f"{a} to {b}", "transform", "") for a, b in device.transforms),
        ("pixel", "unknown" if pixel is None else " x ".join(f"{mm:.5f} mm" for mm in pixel), ""),
        ("image orientation", device.image_orientation or "not said", ""),
        ("transducer", f"{device.scan.probe} {device.scan.geometry}".strip() or "not said", ""),
        ("clip of volumes", "none" if device.clip is None else str(device.clip), ""),
        ("wires of a phantom", str(wires), ""),
        ("for", "--plus-config of convert" + (", --phantom of calibrate wires" if wires else ""), ""),
    ]


def _lag_rows(_: Path, root: Element) -> list[Row]:
    """Rows of a delay, whose sign PLUS has the other way round: a tracker that lags is there negative."""
    (lag_s,) = vector(root, "TrackerLagSec", 1)
    option = "--time-offset-s of calibrate"
    return [("time offset of the tracker", f"{-lag_s:+.4f}", "s"), ("for", option, "")]


def _line_rows(_: Path, root: Element) -> list[Row]:
    count = len(root.findall("Frame[@SegmentationStatus='OK']"))
    return [("lines found", str(count), "frames"), ("for", "comparison alone, as lines are found anew", "")]


_KINDS: dict[str, tuple[str, Callable[[Path, Element], list[Row]]]] = {
    "PlusConfiguration": ("a device set", _device_rows),
    "ProbeCalibrationResult": ("the result of a probe calibration", _device_rows),
    "TemporalCalibrationResults": ("a tracker's delay", _lag_rows),
    "LineSegmentationResults": ("lines found in images", _line_rows),
}


def _claims(_: Path, start: bytes) -> bool:
    return start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<") and any(
        f"<{name}".encode() in start for name in _KINDS
    )


def _open(path: Path, settings: ImportSettings) -> Recording:
    root = read_xml(path)
    if root.tag not in _KINDS:
        raise InvalidInputError(f"{path}: expected a document of PLUS ({', '.join(_KINDS)}), got {root.tag}")
    what, rows_of = _KINDS[root.tag]
    rows = rows_of(path, root)
    fault = InvalidInputError(f"{path}: expected a recording, got {what} of PLUS, which is for {rows[-1][1]}")
    return Recording(path, settings, rows=(("content", what, ""), *rows), fault=fault)


READER = Reader("PLUS document", _claims, _open)
