"""Wires in a water bath and their images, made from geometry and blobs alone: none of the code under test."""

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.points import Detections
from speckle3d.core.wires import WirePhantom

PIXEL_MM = np.array([0.16, 0.15])
SHAPE = (440, 320)

# Two N as published for the fCal phantom and a third of another width: no two sides of it look the same.
ENDS_MM = np.array(
    [
        [[30, 0, 20], [30, 40, 20]],
        [[55, 0, 20], [35, 40, 20]],
        [[60, 0, 20], [60, 40, 20]],
        [[30, 0, 10], [30, 40, 10]],
        [[35, 0, 10], [55, 40, 10]],
        [[60, 0, 10], [60, 40, 10]],
        [[35, 0, 0], [35, 40, 0]],
        [[55, 0, 0], [40, 40, 0]],
        [[60, 0, 0], [60, 40, 0]],
    ],
    dtype=float,
)
PATTERNS = ((0, 1, 2), (3, 4, 5), (6, 7, 8))
NAMES = tuple("abcdefghi")


@dataclass(frozen=True)
class Scene:
    """A sequence: poses of the sensor, where the image truly is, and the pixels of every wire."""

    phantom: WirePhantom
    sensor_from_image: RigidTransform
    world_from_sensor: RigidTransform
    pixels: np.ndarray  # (frame, wire, 2)


def scene(seed, frames=30, degrees=12.0):
    """Images of a phantom, about square to its wires and turned by up to `degrees` about each axis."""
    rng = np.random.default_rng(seed)
    world_from_phantom = RigidTransform.from_components([20.0, -30.0, 60.0], Rotation.random(rng=rng))
    sensor_from_image = RigidTransform.from_components([-31.0, 12.0, 7.0], Rotation.random(rng=rng))
    # The image's x axis against the phantom's, its y axis down through the layers.
    square = Rotation.from_matrix(np.array([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]]).T)
    rotation = Rotation.from_rotvec(np.radians(rng.uniform(-degrees, degrees, (frames, 3)))) * square
    middle = np.column_stack(
        [rng.uniform(44, 47, frames), rng.uniform(10, 30, frames), rng.uniform(7, 13, frames)]
    )
    centre = np.array([*(PIXEL_MM * SHAPE / 2), 0.0])
    phantom_from_image = RigidTransform.from_components(middle - rotation.apply(centre), rotation)
    world_from_sensor = world_from_phantom * phantom_from_image * sensor_from_image.inv()
    pixels = np.stack([cut(phantom_from_image[i]) for i in range(frames)])
    return Scene(
        WirePhantom(NAMES, ENDS_MM, PATTERNS, world_from_phantom),
        sensor_from_image,
        world_from_sensor,
        pixels,
    )


def cut(phantom_from_image):
    """Column and row at which an image shows each wire, from heights of the wires' ends over its plane."""
    image = phantom_from_image.inv()
    front, back = image.apply(ENDS_MM[:, 0]), image.apply(ENDS_MM[:, 1])
    share = front[:, 2] / (front[:, 2] - back[:, 2])
    return (front + share[:, None] * (back - front))[:, :2] / PIXEL_MM


def picture(pixels, seed=None, strength=None, haze=0.02):
    """Grey levels (column, row) of wires at `pixels`: dots with side lobes across and ringing beneath.

    Amplitudes over 60 dB from a saturated 255; `haze` is the mean amplitude of the speckle between them.
    """
    rng = np.random.default_rng(seed)
    x, y = np.arange(SHAPE[0])[:, None] * PIXEL_MM[0], np.arange(SHAPE[1])[None] * PIXEL_MM[1]
    amplitude = np.zeros(SHAPE)
    strength = np.ones(len(pixels)) if strength is None else strength
    for (u, v), a in zip(np.asarray(pixels) * PIXEL_MM, strength, strict=True):
        across, down = x - u, y - v
        amplitude += a * np.exp(-(across**2) / 0.7**2 / 2 - down**2 / 0.25**2 / 2)
        amplitude += 0.3 * a * np.exp(-(across**2) / 2.0**2 / 2 - down**2 / 0.15**2 / 2)
        for k in range(1, 4):
            amplitude += a * 0.35**k * np.exp(-(across**2) / 0.5**2 / 2 - (down - 0.7 * k) ** 2 / 0.2**2 / 2)
    if seed is not None and haze > 0:
        amplitude = np.abs(amplitude + haze * (rng.normal(size=SHAPE) + 1j * rng.normal(size=SHAPE)) / 1.25)
    level = 255.0 * (1.0 + 20.0 * np.log10(np.maximum(amplitude, 1e-9)) / 60.0)
    return np.clip(level, 0, 255).astype(np.uint8)


PLUS_RESULTS = "FreehandCalibration3NWires_fCal2.0.results.xml"


def plus_results(folder, kind):
    """PLUS's frames, points (frame, wire, 2), errors (frame, middle wire), and its ImageToProbe."""
    root = ElementTree.parse(folder / PLUS_RESULTS).getroot()
    matrix = np.array(root.find(".//Transform").get("Matrix").split(), float).reshape(4, 4)
    results = [f for f in root.find(f".//{kind}Data") if f.get("SegmentationStatus") == "OK"]
    points = [[p.get("Position").split()[:2] for p in f.find("SegmentedPoints")] for f in results]
    errors = [[e.get("ErrorMm") for e in f.find("ReprojectionError3DList")] for f in results]
    frames = np.array([int(f.get("Index")) for f in results])
    return frames, np.array(points, dtype=float), np.array(errors, dtype=float), matrix


def candidates(sequence, seed, noise_mm=0.1, missing=()):
    """Dots as found, strongest first: most wires and, weaker, wrong dots and ringing under some wires.

    `missing` holds (frame, wire) pairs without a dot.
    """
    rng = np.random.default_rng(seed)
    dots = []
    for i, true in enumerate(sequence.pixels):
        visible = [w for w in range(len(true)) if (i, w) not in missing]
        wires = true[visible] + rng.normal(size=(len(visible), 2)) * noise_mm / PIXEL_MM
        ringing = wires[rng.permutation(len(wires))[:4]] + [0.0, 1.2 / PIXEL_MM[1]]
        anywhere = rng.uniform(0, 1, (6, 2)) * SHAPE
        pixels = np.concatenate([wires, ringing, anywhere])
        score = np.concatenate(
            [rng.uniform(60, 150, len(wires)), rng.uniform(20, 50, 4), rng.uniform(20, 100, 6)]
        )
        order = np.argsort(-score)
        dots.append((np.full(len(score), i), pixels[order], score[order]))
    frame, pixels, score = (np.concatenate(column) for column in zip(*dots, strict=True))
    return Detections(frame, pixels, score=score)
