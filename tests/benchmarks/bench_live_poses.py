"""How far live poses are from off-line ones.

Run: ``python tests/benchmarks/bench_live_poses.py [SWEEP...] [--curves CURVES] [--step 4]``. For each
sweep, distances of the image's centre, mm: of the pose first given for a frame from the last of `track` on
the frames up to it (median and most over every fourth frame), and from the whole sweep's (most); of that
part's pose from the whole sweep's (most), which no live method can know; and of all poses, once the sweep
has ended, from the whole sweep's (most). They are those to a path or to its mirror image, whichever is
nearer: images do not tell the sign of motion, and here nothing else does.
"""

from dataclasses import replace
from pathlib import Path

import bench
import numpy as np
from scipy.spatial.transform import RigidTransform

import speckle3d as s3
from speckle3d.core.geometry import mirrored
from speckle3d.live.tracking import LiveTracker


def apart_mm(poses, reference, centre_mm):
    """Distance of each pose's centre from the other's or, where all are nearer to it, its mirror image's."""
    centres = poses.apply(centre_mm)
    either = [np.linalg.norm(centres - p.apply(centre_mm), axis=-1) for p in (reference, mirrored(reference))]
    return min(either, key=np.max)


def row(sweep, curves, step):
    """The figures of one sweep."""
    centre = sweep.grid.centre_mm

    def poses_of(frames):
        return s3.track(sweep.part(0, frames), curves).image

    whole, apart = poses_of(len(sweep)), []
    live = LiveTracker(sweep, curves, background=False)
    first = [live.append(sweep.frames[k], float(k)).world_from_image for k in range(len(sweep))]
    live.revise(len(live))
    last = live.poses
    for k in [*range(2, len(sweep), step), len(sweep) - 1]:
        part, later = poses_of(k + 1)[-1:], whole[k : k + 1]
        live_pose = RigidTransform.concatenate([first[k]])
        pairs = (live_pose, part), (live_pose, later), (part, later)
        apart.append([apart_mm(*pair, centre)[0] for pair in pairs])
    apart = np.array(apart)
    return [np.median(apart[:, 0]), *apart.max(axis=0), apart_mm(last, whole, centre).max()]


def main():
    parser = bench.parser_of(__doc__)
    parser.add_argument("sweeps", type=Path, nargs="*", default=[bench.DATA / "phantom.h5"])
    parser.add_argument("--curves", type=Path, default=bench.DATA / "curves.h5")
    parser.add_argument("--step", type=int, default=4)
    parser.add_argument("--frames", type=int, default=100000, help="of each sweep, at most")
    options = bench.parse_options(parser, step=8, frames=16)
    curves = s3.load_curves(options.curves)
    print("| sweep | first sent, against the frames up to it: median | most | against the whole | ", end="")
    print("that part against the whole | at the end |")
    print("|---|---|---|---|---|---|")
    for path in options.sweeps:
        # Sensors would settle the sign.
        sweep = replace(s3.load_sweep(path), orientation=None, tracker=None)
        figures = row(sweep.part(0, min(options.frames, len(sweep))), curves, options.step)
        print(f"| {path.stem} | " + " | ".join(f"{value:.3f}" for value in figures) + " |", flush=True)


if __name__ == "__main__":
    main()
