"""How far live poses are from off-line ones.

Run: ``python tests/benchmarks/bench_live_poses.py [SWEEP...] [--curves CURVES] [--step 4]``. For each
sweep, distances of the image's centre, mm: of the pose first given for a frame from the last of `track` on
the frames up to it (median and most over every fourth frame), and from the whole sweep's (most); of that
part's pose from the whole sweep's (most), which no live method can know; and of all poses, once the sweep
has ended, from the whole sweep's (most). They are those to a path or to its mirror image, whichever is
nearer: images do not tell the sign of motion, and here nothing else does.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from options import parsed
from scipy.spatial.transform import RigidTransform

import speckle3d as s3
from speckle3d.core.geometry import mirrored
from speckle3d.live.tracking import LiveTracker

SHIPPED = Path(__file__).resolve().parents[2] / "data"


def apart_mm(poses, others, centre_mm):
    """Distance of each pose's centre from the other's or, where all are nearer to it, its mirror image's."""
    one = poses.apply(centre_mm)
    either = [np.linalg.norm(one - each.apply(centre_mm), axis=-1) for each in (others, mirrored(others))]
    return min(either, key=np.max)


def row(sweep, curves, step):
    """The figures of one sweep."""
    centre = sweep.grid.centre_mm

    def tracked(frames):
        return s3.track(sweep.part(0, frames), curves).image

    whole, apart = tracked(len(sweep)), []
    with LiveTracker(sweep, curves, background=False) as live:
        first = [live.append(sweep.frames[k], float(k)).world_from_image for k in range(len(sweep))]
        live.revise()
        ended = live.poses
    for k in [*range(2, len(sweep), step), len(sweep) - 1]:
        part, sent, later = tracked(k + 1)[-1:], RigidTransform.concatenate([first[k]]), whole[k : k + 1]
        apart.append([apart_mm(*both, centre)[0] for both in ((sent, part), (sent, later), (part, later))])
    apart = np.array(apart)
    return [np.median(apart[:, 0]), *apart.max(axis=0), apart_mm(ended, whole, centre).max()]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sweeps", type=Path, nargs="*", default=[SHIPPED / "phantom.h5"])
    parser.add_argument("--curves", type=Path, default=SHIPPED / "curves.h5")
    parser.add_argument("--step", type=int, default=4)
    parser.add_argument("--frames", type=int, default=100000, help="of each sweep, at most")
    options = parsed(parser, step=8, frames=16)
    curves = s3.load_curves(options.curves)
    print("| sweep | first sent, against the frames up to it: median | most | against the whole | ", end="")
    print("that part against the whole | at the end |")
    print("|---|---|---|---|---|---|")
    for path in options.sweeps:
        # Sensors would settle the sign.
        sweep = replace(s3.load_sweep(path), orientation=None, tracker=None)
        figures = row(sweep.part(0, min(options.frames, len(sweep))), curves, options.step)
        print(f"| {path.stem} | " + " | ".join(f"{each:.3f}" for each in figures) + " |", flush=True)


if __name__ == "__main__":
    main()
