"""Recordings of a floor, with a membrane above it, and of N-wires, drawn from geometry alone."""

import numpy as np
from calibration_examples import COLUMNS, PIXEL_MM, scan_plane
from wire_scenes import PIXEL_MM as WIRE_PIXEL_MM
from wire_scenes import picture, scene

from speckle3d.core.grid import ImageGrid
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import BModeSettings, Sweep, Tracker
from speckle3d.io.family.sweep_writer import write_sweep

MEMBRANE_MM = 6.0
"""How far above the floor a second echo lies, along the columns."""


def floor_recording(path):
    """Write a recording of a floor; returns the row of its line at the middle column of each frame.

    In the first frame, a second, equal echo lies above the floor's.
    """
    rng, frames = np.random.default_rng(3), 40
    scan = scan_plane(rng, frames, tilt_deg=30.0, roll_deg=15.0)
    ends = scan.lines.pixels.reshape(-1, 2, 2)
    columns, rows = np.arange(COLUMNS)[None, :, None], np.arange(COLUMNS)[None, None]
    share = (columns - ends[:, :1, None, 0]) / (ends[:, 1:, None, 0] - ends[:, :1, None, 0])
    at = ends[:, :1, None, 1] * (1 - share) + ends[:, 1:, None, 1] * share
    level = rng.rayleigh(8.0, (frames, COLUMNS, COLUMNS))
    away_mm = (rows - at) * PIXEL_MM[1]
    level += 200.0 * np.exp(-(away_mm**2) / 0.4**2 / 2)
    level[0] += 200.0 * np.exp(-((away_mm[0] + MEMBRANE_MM) ** 2) / 0.4**2 / 2)
    images = np.clip(level, 0, 255).astype(np.uint8)
    _write(path, images, PIXEL_MM, scan.lines.world_from_sensor[::2])
    return at[:, (COLUMNS - 1) // 2 : (COLUMNS - 1) // 2 + 2, 0].mean(axis=1)


def wire_recording(path, config):
    """Write a recording of N-wires and PLUS's configuration of them; returns the scene."""
    sequence = scene(4, 16)
    images = np.stack([picture(pixels, seed=i) for i, pixels in enumerate(sequence.pixels)])
    _write(path, images, WIRE_PIXEL_MM, sequence.world_from_sensor)
    phantom = sequence.phantom
    patterns = []
    for pattern in phantom.patterns:
        wires = "".join(
            f'<Wire Name="{phantom.names[w]}" '
            + " ".join(
                f'EndPoint{end}="{" ".join(map(str, place))}"'
                for end, place in zip(("Front", "Back"), phantom.ends_mm[w], strict=True)
            )
            + "/>"
            for w in pattern
        )
        patterns.append(f'<Pattern Type="NWire">{wires}</Pattern>')
    config.write_text(
        f"<PlusConfiguration><PhantomDefinition><Geometry>{''.join(patterns)}</Geometry>"
        "</PhantomDefinition></PlusConfiguration>"
    )
    return sequence


def _write(path, images, pixel_mm, poses):
    times = np.arange(len(images)) / 10.0
    grid = ImageGrid(images.shape[1], images.shape[2], *map(float, pixel_mm))
    tracker = Tracker(TimedPoses(times, poses))
    write_sweep(path, Sweep(images, grid, BModeSettings(60.0), times, tracker=tracker))
