"""B-mode frames of two crossing wires as a scanner shows them, with everything that is not a crossing.

Two thin, slightly bent wires are met by a beam that is thickest away from its focus: each is bright where it
lies in the beam and across it, so that a frame shows an X, one long line with a short faint one on it, or two
short strokes. Each point of a wire is blurred by pulse and beam and leaves an arc of side lobes. Added are
speckle, scatterers fixed in the phantom, the skin's reverberations, a step of gain, compression to 8 bits,
scan conversion of a linear or convex probe, and a scanner's lettering. Nothing is drawn by a line filter.
"""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

STEP_MM = 0.1
"""Between samples of a wire."""


@dataclass(frozen=True)
class Probe:
    """What the scanner shows: `radius_mm` is infinite for a linear array.

    Attributes
    ----------
    shape : tuple of int
        Columns and rows of the video frame.
    corner_px : ndarray, shape (2,)
        Where the array's middle is in it.
    width_mm : float
        Length of the array, or of its arc.
    """

    shape: tuple[int, int]
    pixel_mm: np.ndarray
    corner_px: np.ndarray
    depth_mm: float
    width_mm: float
    radius_mm: float
    beams: int
    samples: int

    def beam_range(self, x, y):
        """Number of the beam and of the sample at points in mm from the array's middle."""
        if np.isinf(self.radius_mm):
            across, depth = x, y
        else:
            across = self.radius_mm * np.arctan2(x, y + self.radius_mm)
            depth = np.hypot(x, y + self.radius_mm) - self.radius_mm
        return (across / self.width_mm + 0.5) * (self.beams - 1), depth / self.depth_mm * (self.samples - 1)

    def direction(self, x, y):
        """Of the beams through points, mm."""
        if np.isinf(self.radius_mm):
            return 0.0, 1.0
        length = np.hypot(x, y + self.radius_mm)
        return x / length, (y + self.radius_mm) / length

    def from_image(self, pixels):
        """Points in mm from the array's middle."""
        return (np.asarray(pixels) - self.corner_px) * self.pixel_mm

    def inside(self, pixels):
        """Whether pixels show anything."""
        beam, sample = self.beam_range(*self.from_image(pixels).T)
        in_scan = (beam > 0) & (beam < self.beams - 1) & (sample > 0) & (sample < self.samples - 1)
        return in_scan & np.all((pixels >= 0) & (pixels <= np.array(self.shape) - 1), axis=-1)


@dataclass(frozen=True)
class World:
    """Frames, what the tracker said, and the truth.

    Attributes
    ----------
    images : ndarray of uint8, shape (n, column, row)
    crossing_px : ndarray, shape (n, 2)
        Nearest point of each image to the crossing.
    is_visible : ndarray of bool, shape (n,)
        Whether the beam meets the crossing, inside the picture.
    """

    images: np.ndarray
    pixel_mm: np.ndarray
    world_from_sensor: RigidTransform
    crossing_px: np.ndarray
    is_visible: np.ndarray


def random_probe(rng):
    """A linear or convex probe in a video frame."""
    shape = [(640, 480), (400, 400), (512, 512), (576, 432)][rng.integers(4)]
    if rng.random() < 0.5:
        depth, width, radius = rng.uniform(40, 90), rng.uniform(38, 52), np.inf
        extent = width, depth
    else:
        depth, radius = rng.uniform(70, 150), rng.uniform(40, 60)
        angle = np.deg2rad(rng.uniform(55, 72))
        width = radius * angle
        extent = 2 * np.sin(angle / 2) * (radius + depth), depth + 2.0
    fill = rng.uniform(0.82, 1.0)
    pixel = max(extent[1] / (fill * shape[1]), extent[0] / (1.15 * shape[0]))
    size = pixel * np.array([rng.uniform(0.95, 1.05), 1.0])
    corner = np.array([shape[0] * rng.uniform(0.47, 0.53), rng.uniform(0.0, 0.06) * shape[1]])
    return Probe(shape, size, corner, depth, width, radius, 160, min(700, int(depth / 0.12)))


def random_look(rng, probe):
    """Settings of a scanner and a phantom; decibels are relative to a wire across.

    The floor of its bath, so far beyond the crossing, is a long line that wires seem to cross, too.
    """
    deep = probe.depth_mm / 80.0
    return SimpleNamespace(
        elevation_mm=rng.uniform(0.7, 1.2) * deep**0.5,
        focus_mm=rng.uniform(0.3, 0.7) * probe.depth_mm,
        spread_mm=rng.uniform(0.3, 0.6) * probe.depth_mm,
        pulse_mm=rng.uniform(0.2, 0.45) * deep**0.5,
        # Along the array: a convex one's beams spread by the angle of wavelength over aperture, 0.02 rad.
        beam_mm=rng.uniform(0.4, 0.9) * (deep**0.5 if np.isinf(probe.radius_mm) else 0.7),
        lobes_db=rng.uniform(-38, -16),
        lobes_mm=rng.uniform(6, 20),
        slope_db=rng.uniform(3, 10),
        speckle_db=rng.uniform(-42, -20),
        noise_db=rng.uniform(-50, -38),
        range_db=rng.uniform(40, 62),
        gain_step_db=rng.uniform(-10, 10),
        skin_db=rng.uniform(-15, 10),
        skin_mm=rng.uniform(2, 9),
        points_per_cm3=np.exp(rng.uniform(np.log(0.1), np.log(4.0))),
        points_db=rng.uniform(-14, 7),
        tail=rng.uniform(0.0, 0.35),
        faint_db=rng.uniform(-9, 0),
        lettering=bool(rng.random() < 0.8),
        floor_db=rng.uniform(-15, 8) if rng.random() < 0.4 else -np.inf,
        floor_mm=rng.uniform(0.15, 0.6) * probe.depth_mm,
    )


def crossing_world(seed, frames=54):
    """Images of a crossing by a hand that turns the probe about it, and a tracker's readings."""
    rng = np.random.default_rng([seed, 15])
    probe = random_probe(rng)
    look = random_look(rng, probe)
    where, turns = _hand(rng, frames)
    centre, pixels = rng.uniform(-300, 300, 3), _places(rng, probe, where)
    away = 0.35 * look.elevation_mm * rng.standard_normal(frames)
    misses = rng.random(frames) < 0.12  # the beam misses the crossing
    away = np.where(misses, rng.choice([-1, 1], frames) * rng.uniform(4, 9, frames) * look.elevation_mm, away)
    flat = np.column_stack([pixels * probe.pixel_mm, away])
    base = Rotation.random(rng=rng)
    world_from_image = RigidTransform.from_components(centre - (base * turns).apply(flat), base * turns)
    # Who holds the probe sees to it that the crossing shows.
    draws = [_directions(rng) for _ in range(40)]
    visible = [_both_visible(probe, look, pixels, turns, along) for along in draws]
    best = int(np.argmax([mask.sum() for mask in visible]))
    wires = _wires(rng, base, centre, draws[best])
    points = _scatterers(rng, look, centre)
    letters = _lettering(rng, probe) if look.lettering else None
    floor = centre + base.apply([0.0, look.floor_mm, 0.0]), base.apply([0.0, 1.0, 0.0])
    texture = _skin(rng, probe, look)
    images = np.stack(
        [_frame(rng, probe, look, pose, wires, points, floor, texture, letters) for pose in world_from_image]
    )
    mounting = RigidTransform.from_components(rng.uniform(-120, 120, 3), Rotation.random(rng=rng))
    readings = world_from_image * mounting.inv() * _errors(rng, frames)
    is_visible = (np.abs(away) < 1.2 * look.elevation_mm) & probe.inside(pixels) & visible[best]
    return World(images, probe.pixel_mm, readings, pixels, is_visible)


def _hand(rng, frames):
    """Relative places in the picture, and rotations, that wander; the probe is lifted and turned at times."""
    time = np.arange(frames)
    reach = np.deg2rad([rng.uniform(15, 40), rng.uniform(15, 35), rng.uniform(12, 30)])
    angles = np.empty((frames, 3))
    for axis in range(3):
        jumps = np.repeat(rng.uniform(-1, 1, frames // 3 + 1), 3)[:frames]
        wave = np.sin(2 * np.pi * rng.uniform(0.02, 0.11) * time + rng.uniform(0, 7))
        angles[:, axis] = reach[axis] * (0.6 * jumps + 0.5 * wave)
    where = np.repeat(rng.uniform(0, 1, (frames // 2 + 1, 2)), 2, axis=0)[:frames]
    where = np.clip(where + rng.normal(0, 0.04, (frames, 2)), 0, 1)
    # About the beam's axis, about the array's, and in the image.
    turn = Rotation.from_euler("yxz", angles)
    return where, turn


def _places(rng, probe, where):
    """Pixels at these parts of the picture, some near its edges."""
    depth = (0.12 + 0.82 * where[:, 1]) * probe.depth_mm
    across = (where[:, 0] - 0.5) * 0.96 * probe.width_mm
    if np.isinf(probe.radius_mm):
        place = np.column_stack([across, depth])
    else:
        angle = across / probe.radius_mm
        r = probe.radius_mm + depth
        place = np.column_stack([r * np.sin(angle), r * np.cos(angle) - probe.radius_mm])
    return place / probe.pixel_mm + probe.corner_px


def _directions(rng):
    """Unit vectors along two wires that cross at 40 to 90 degrees, nearly in a plane, shape (2, 3)."""
    half = np.deg2rad(rng.uniform(20, 45))
    angle = rng.uniform(-0.35, 0.35) + np.array([-half, half])
    along = np.column_stack([np.cos(angle), np.sin(angle), rng.normal(0, np.deg2rad(4), 2)])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return Rotation.from_rotvec(rng.normal(0, 0.3, 3)).apply(along)


def _both_visible(probe, look, pixels, turns, along):
    """In which frames an eye finds two wires: both above the speckle, of not too different brightness.

    They must be 20 degrees apart, or both be strokes shorter than 8 mm.
    """
    x, y = probe.from_image(pixels).T
    beam = probe.direction(x, y)
    in_image = np.stack([turns.inv().apply(direction) for direction in along])
    level = _slope_loss_db(look, in_image, beam) + np.array([[0.0], [look.faint_db]])
    flat = in_image[..., :2] / np.linalg.norm(in_image[..., :2], axis=2, keepdims=True)
    apart = np.abs(np.sum(flat[0] * flat[1], axis=1)) < np.cos(np.deg2rad(20))
    short = 2.0 * look.elevation_mm / np.tan(np.arcsin(np.abs(in_image[..., 2]))) < 4.0
    background = max(look.speckle_db, look.noise_db)
    clear = (level.min(axis=0) > background + 10) & (np.ptp(level, axis=0) < 14)
    clear &= level.min(axis=0) + look.gain_step_db * (y > probe.depth_mm / 2) > -look.range_db + 12
    return clear & (apart | short.all(axis=0))


def _slope_loss_db(look, along, beam):
    """Level of a wire's echo relative to one across the beam; 45 degrees cost `slope_db`."""
    sine = np.abs(along[..., 0] * beam[0] + along[..., 1] * beam[1])
    return -look.slope_db * (np.arcsin(np.clip(sine, 0, 1)) / (np.pi / 4)) ** 2


def _wires(rng, base, centre, along):
    """Points of two bent wires, shape (2, n, 3), and the directions along them."""
    t = np.arange(-90, 90 + STEP_MM, STEP_MM)[:, None]
    curves = []
    for direction in along:
        bend = np.cross(direction, rng.normal(size=3))
        bend /= np.linalg.norm(bend)
        curve = t * direction + t**2 / (2 * rng.uniform(120, 900)) * bend
        curves.append(base.apply(curve) + centre)
    # They touch and do not meet.
    curves[1] = curves[1] + base.apply([0, 0, rng.uniform(0.0, 0.4)])
    return np.array(curves), base.apply(along)


def _scatterers(rng, look, centre):
    """Places and complex amplitudes of grains and bubbles in the phantom."""
    reach = 110.0
    count = int(look.points_per_cm3 * (2 * reach) ** 3 / 1000.0)
    places = centre + rng.uniform(-reach, reach, (count, 3))
    size = 10 ** ((look.points_db + rng.normal(0, 4, count)) / 20.0)
    return places, size * np.exp(2j * np.pi * rng.random(count))


def _frame(rng, probe, look, world_from_image, wires, points, floor, skin, letters):
    echoes = np.zeros((probe.beams, probe.samples), complex)
    into = world_from_image.inv()
    faint = 10 ** (look.faint_db / 20.0)
    for number, (curve, along) in enumerate(zip(*wires, strict=True)):
        place, direction = into.apply(curve), into.rotation.apply(along)
        grain = gaussian_filter1d(rng.standard_normal((2, len(curve))), rng.uniform(4, 14), axis=1)
        grain /= grain.std()
        amplitude = 1.0 + 0.35 * (grain[0] + 1j * grain[1])
        x, y = probe.from_image(place[:, :2] / probe.pixel_mm).T
        beam = probe.direction(x, y)
        loss = 10 ** (_slope_loss_db(look, direction, beam) / 20.0)
        weight = (faint if number else 1.0) * amplitude * loss * STEP_MM / 0.6
        _splat(echoes, probe, x, y, weight * _elevation_weight(look, y, place[:, 2]))
    place = into.apply(points[0])
    near = np.abs(place[:, 2]) < 6 * look.elevation_mm
    x, y = probe.from_image(place[near, :2] / probe.pixel_mm).T
    _splat(echoes, probe, x, y, points[1][near] * _elevation_weight(look, y, place[near, 2]))
    if np.isfinite(look.floor_db):
        _splat(echoes, probe, *_floor(rng, probe, look, into.apply(floor[0]), into.rotation.apply(floor[1])))
    speckle = rng.standard_normal((2, *echoes.shape))
    specular = _blur(probe, look, echoes, lobes=True)
    grains = _blur(probe, look, speckle[0] + 1j * speckle[1], lobes=False)
    grains *= 10 ** (look.speckle_db / 20.0) / np.sqrt(np.mean(np.abs(grains) ** 2))
    hiss = rng.standard_normal((2, *echoes.shape)) * 10 ** (look.noise_db / 20.0)
    depth = np.linspace(0, 1, probe.samples)
    total = np.abs(
        specular + grains + skin * rng.uniform(0.7, 1.3) + (hiss[0] + 1j * hiss[1]) * (0.3 + 1.2 * depth)
    )
    level = 20 * np.log10(total + 1e-4) + look.gain_step_db * (depth > 0.5)
    grey = np.clip(255.0 * (level + look.range_db) / (look.range_db + 2.0), 0, 255)
    column, row = np.meshgrid(*(np.arange(n) for n in probe.shape), indexing="ij")
    pixels = np.stack([column, row], axis=-1)
    beam, sample = probe.beam_range(*np.moveaxis(probe.from_image(pixels), 2, 0))
    picture = map_coordinates(grey, [beam, sample], order=1, cval=0.0)
    picture = np.clip(picture + rng.normal(0, 1.0, picture.shape) * (picture > 0), 0, 255)
    if letters is not None:
        picture = np.maximum(picture, letters)
    return picture.astype(np.uint8)


def _floor(rng, probe, look, place, normal):
    """Points where the image meets a plane, and their amplitudes: a mirror, weak where met aslant."""
    across = np.array([-normal[1], normal[0]]) / np.hypot(*normal[:2])
    place = probe.from_image(place[:2] / probe.pixel_mm) - place[2] * np.array([0, normal[2]])
    t = np.arange(-120, 120, STEP_MM)[:, None]
    x, y = (place + t * across).T
    beam = probe.direction(x, y)
    aslant = np.arccos(np.clip(np.abs(beam[0] * normal[0] + beam[1] * normal[1]), 0, 1))
    grain = 1.0 + 0.4 * gaussian_filter1d(rng.standard_normal(len(x)), 8) / 0.19
    return x, y, grain * 10 ** ((look.floor_db - 18 * (aslant / 0.5) ** 2) / 20.0) * STEP_MM / 0.6


def _elevation_weight(look, y, z):
    """Amplitude of what lies `z` out of the image: the beam is thinnest at its focus."""
    width = look.elevation_mm * np.sqrt(1.0 + ((y - look.focus_mm) / look.spread_mm) ** 2)
    return np.exp(-0.5 * (z / width) ** 2)


def _splat(echoes, probe, x, y, weight):
    beam, sample = probe.beam_range(x, y)
    b, s = np.floor(beam).astype(int), np.floor(sample).astype(int)
    inside = (b >= 0) & (b < probe.beams - 1) & (s >= 0) & (s < probe.samples - 1)
    b, s, fb, fs, w = b[inside], s[inside], (beam - b)[inside], (sample - s)[inside], weight[inside]
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        np.add.at(echoes, (b + i, s + j), w * np.where(i, fb, 1 - fb) * np.where(j, fs, 1 - fs))


def _blur(probe, look, echoes, lobes):
    """Pulse, tail, beam (wider away from the focus) and arcs of side lobes, of unit peak for one point."""
    pitch, spacing = probe.width_mm / (probe.beams - 1), probe.depth_mm / (probe.samples - 1)
    pulse = max(look.pulse_mm / spacing, 0.6)
    out = gaussian_filter1d(echoes, pulse, axis=1) * np.sqrt(2 * np.pi) * pulse
    if lobes and look.tail > 0.05:
        late, gap = np.zeros_like(out), round(3.5 * pulse)
        for k in range(1, 4):
            late[:, k * gap :] += look.tail**k * out[:, : -k * gap]
        out = out + late
    depth = np.linspace(0, probe.depth_mm, probe.samples)
    narrow = look.beam_mm / pitch
    thin, wide = (gaussian_filter1d(out, w, axis=0) * np.sqrt(2 * np.pi) * w for w in (narrow, 1.8 * narrow))
    mix = np.clip(np.abs(depth - look.focus_mm) / (2.0 * look.spread_mm), 0, 1)
    beam = (1 - mix) * thin + mix * wide / 1.5
    if not lobes:
        return beam
    reach = int(look.lobes_mm / pitch)
    arcs = np.zeros_like(beam)
    for step in range(-reach, reach + 1, 2):
        shape = (
            np.cos(np.pi * step / (2 * reach + 1)) * (0.6 + 0.4 * np.cos(step * 1.3)) * (-1) ** (step // 2)
        )
        lobe = np.zeros_like(out)
        if step >= 0:
            lobe[step:] = out[: len(out) - step]
        else:
            lobe[:step] = out[-step:]
        # An echo from the side comes late: a linear array's arcs bend down.
        if np.isinf(probe.radius_mm):
            late = round((step * pitch) ** 2 / (2 * 0.5 * probe.depth_mm) / spacing)
            lobe[:, late:] = lobe[:, : probe.samples - late].copy()
            lobe[:, :late] = 0
        arcs += shape * lobe
    return beam + 10 ** (look.lobes_db / 20.0) * arcs


def _skin(rng, probe, look):
    """Reverberations at the array: bright stripes along it that fade."""
    depth = np.linspace(0, probe.depth_mm, probe.samples)
    period = rng.uniform(0.8, 2.5)
    stripes = (0.5 + 0.5 * np.cos(2 * np.pi * depth / period)) ** 2
    fade = np.exp(-depth / (look.skin_mm / 2)) * 10 ** (look.skin_db / 20.0)
    uneven = 1 + 0.3 * gaussian_filter1d(rng.standard_normal(probe.beams), 12) / 0.15
    return np.abs(uneven)[:, None] * (stripes * fade)


def _lettering(rng, probe):
    """Lines of letters and a grey wedge, as scanners burn in."""
    picture = np.zeros(probe.shape)
    columns, rows = probe.shape
    for _ in range(rng.integers(3, 9)):
        block = np.kron(rng.random((rng.integers(20, 90), 7)) < 0.45, np.ones((1, rng.integers(1, 3))))
        u, v = rng.integers(0, columns - len(block)), rng.choice([2, rows - 18])
        part = picture[u : u + len(block), v : v + block.shape[1]]
        part[:] = np.maximum(part, 230 * block)
    picture[6:14, 30 : 30 + rows // 4] = np.linspace(255, 5, rows // 4)
    return picture


def _errors(rng, frames):
    """A tracker's jitter, and a wander by 0.3 mm that takes some ten frames to change."""
    keep = np.exp(-1 / 12.0)
    wander = np.zeros((frames, 3))
    wander[0] = rng.standard_normal(3)
    for n in range(1, frames):
        wander[n] = keep * wander[n - 1] + np.sqrt(1 - keep**2) * rng.standard_normal(3)
    turn = Rotation.from_rotvec(np.deg2rad(0.15) * rng.standard_normal((frames, 3)))
    shift = 0.25 * rng.standard_normal((frames, 3)) + 0.3 * wander
    return RigidTransform.from_components(shift, turn)
