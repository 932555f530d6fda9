"""Length by what real images have: shadow, no contact, text, unknown compression, averages, moving tissue.

Run: ``python tests/benchmarks/bench_real_images.py [--seeds 3] [--length-mm 6] [--signal rf|bmode]``.
"""

from dataclasses import dataclass, replace

import bench
import numpy as np
import spoiled_images as spoil
from accuracy_set import SHEET, grey
from scipy.spatial.transform import RigidTransform
from sweep_examples import frames_of

from speckle3d.core.errors import Speckle3DError
from speckle3d.core.sweep import Sweep
from speckle3d.io.family.curves import read_curves
from speckle3d.sheet_curves import data_sheet_curves
from speckle3d.simulation.presets import SimulationSettings, simulate
from speckle3d.simulation.receiver import received
from speckle3d.tracking import track

STRAIN, SLIDING, PULSE_MM, PULSE_HZ, VESSEL_MM = 0.01, 0.05, 0.1, 1.2, 4.0
"""Strain at the end of the sweep; share of the probe's way that tissue goes along; pulse; depth over which it
falls to 1/e on either side of a vessel in the middle of the image."""


@dataclass(frozen=True)
class MovingMedium:
    """A medium whose scatterers have moved along the beam by some share or depth since the first frame."""

    medium: object
    poses: RigidTransform
    shift_mm: object
    """Of depths, at a frame: (depth_mm, frame) to mm."""

    def scatterers(self, medium_from_image, box):
        apart = self.poses.translation - medium_from_image.translation
        frame = int(np.argmin((apart**2).sum(axis=1)))
        for position, strength in self.medium.scatterers(medium_from_image, box):
            place = position.copy()
            place[:, 1] += self.shift_mm(position[:, 1], frame)
            yield place, strength


def moving(sweep):
    """Frames of the same sweep over tissue at rest and in motion."""
    frames, poses = sweep.frames, sweep.frames.medium_from_image
    way = poses.translation[:, 2] - poses.translation[0, 2]
    pulse = PULSE_MM * np.sin(2 * np.pi * PULSE_HZ * (sweep.frame_time_s - sweep.frame_time_s[0]))
    middle = sweep.grid.depth_mm / 2

    def along_beam(shift_mm):
        return replace(frames, medium=MovingMedium(frames.medium, poses, shift_mm))

    def along_sweep(shift_mm):
        back = RigidTransform.from_translation(np.outer(shift_mm, [0.0, 0.0, -1.0]))
        return replace(frames, medium_from_image=back * poses)

    return {
        "at rest": frames,
        "pressed by 1 %": along_beam(lambda y, k: -STRAIN * y * k / len(sweep)),
        "sliding along by 5 %": along_sweep(SLIDING * way),
        "pulsating 0.1 mm along the sweep": along_sweep(pulse),
        "pulsating 0.1 mm along the beam": along_beam(
            lambda y, k: pulse[k] * np.exp(-np.abs(y - middle) / VESSEL_MM)
        ),
    }


def spoilt(sweep, is_bmode):
    """The same sweep at rest, as machines show it where something is in the way."""
    _, vectors, samples = sweep.frames.shape
    third = vectors // 3
    yield "a third in shadow", spoil.shadow(sweep, slice(third, 2 * third), slice(samples // 4, None))
    yield "a third without contact", spoil.ringing(sweep, slice(0, third))
    if not is_bmode:
        return
    image = in_memory(grey(sweep))
    yield "text", spoil.text_overlay(image)
    for count in (2, 3):
        sums = np.cumsum(np.pad(image.frames.astype(float), ((1, 0), (0, 0), (0, 0))), axis=0)
        means = np.rint((sums[count:] - sums[:-count]) / count).astype(np.uint8)
        yield f"means of {count} frames", spoil.with_frames(image, means, range(count - 1, len(image)))
    pitch = image.grid.vector_pitch_mm, image.grid.sample_spacing_mm
    for range_db in (40.0, 80.0):
        image = in_memory(received(sweep, dynamic_range_db=range_db))
        yield f"{range_db:g} dB", image
        rows = image.frames.swapaxes(1, 2)
        yield (
            f"{range_db:g} dB, not given",
            Sweep.from_arrays(rows, pitch_mm=pitch, frame_time_s=image.frame_time_s, truth=sweep.truth),
        )


def in_memory(sweep):
    """The sweep without sensors, its frames in memory."""
    return replace(sweep, frames=frames_of(sweep), tracker=None, orientation=None)


def cases(sweep, is_bmode):
    """The same sweep as it is and in all those ways, by name."""
    sweeps = {name: in_memory(replace(sweep, frames=frames)) for name, frames in moving(sweep).items()}
    sweeps |= dict(spoilt(sweeps["at rest"], is_bmode))
    is_echo = {name: case.signal == sweep.signal for name, case in sweeps.items()}
    return {name: in_memory(grey(c)) if is_bmode and is_echo[name] else c for name, c in sweeps.items()}


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("--first-seed", type=int, default=5001)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--length-mm", type=float, default=6.0)
    parser.add_argument("--vectors", type=int, default=36)
    parser.add_argument("--signal", choices=("rf", "bmode"), default="rf")
    parser.add_argument("--curves", help="file; by default curves of a data sheet")
    options = bench.parse_options(parser, seeds=1, length_mm=1.5, vectors=20)
    size = {"length_mm": options.length_mm, "vectors": options.vectors, "samples": 2600}
    rows, curves = {}, options.curves and read_curves(options.curves)
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        sweep = simulate(SimulationSettings(preset="tissue", seed=seed, **size))[0].sweep
        centre = sweep.grid.centre_mm
        for name, case in cases(sweep, options.signal == "bmode").items():
            true = np.ptp((case.truth[0].inv() * case.truth).apply(centre)[:, 2])
            try:
                tracking = track(replace(case, truth=None), curves or data_sheet_curves(SHEET, case))
            except Speckle3DError:
                rows.setdefault(name, []).append((np.nan, np.nan, np.nan))
                continue
            length = np.ptp(tracking.image.apply(centre)[:, 2])
            sigma = np.sqrt(tracking.covariance[:, 2, 2].max())
            rows.setdefault(name, []).append((length / true - 1, sigma / length, (length - true) / sigma))
    print(f"{'':34s} length, % (nan: refused)   rms   claim, %   error over claim")
    for name, values in rows.items():
        error, claim, score = np.array(values)[np.isfinite(values).all(axis=1)].T
        text = " ".join(f"{100 * e:+6.1f}" for e, _, _ in values)
        if error.size:
            rms = np.sqrt(np.mean(error**2))
            text += f"   {100 * rms:5.1f}   {100 * claim.mean():5.1f}   {np.abs(score).max():.1f}"
        print(f"{name:34s} {text}")


if __name__ == "__main__":
    main()
