"""How far live poses are from off-line ones.

Run: ``python tests/benchmarks/bench_live_poses.py CURVES SWEEP... [--step 4]``. For each sweep, distances of
the image's centre, mm: of the pose first given for a frame from the last of `track` on the frames up to it
(median and most over every fourth frame), and from the whole sweep's (most); of that part's pose from the
whole sweep's (most), which no live method can know; and of all poses, once the sweep has ended, from the
whole sweep's (most). They are those to a path or to its mirror image, whichever is nearer: images do not tell
the sign of motion, and here nothing else does.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np
from options import parsed
from scipy.spatial.transform import RigidTransform

import speckle3d as s3
from speckle3d.core.geometry import mirrored
from speckle3d.live.tracking import LiveTracker


def apart_mm(poses, others, centre_mm):
    """Distance of each pose's centre from the other's or, where all are nearer to it, its mirror image's."""
    one = poses.apply(centre_mm)
    either = [np.linalg.norm(one - each.apply(centre_mm), axis=-1) for each in (others, mirrored(others))]
    return min(either, key=np.max)


def row(path, curves, step):
    """The figures of one sweep."""
    # Sensors would settle the sign.
    sweep = dataclasses.replace(s3.load_sweep(path), orientation=None, tracker=None)
    centre = sweep.grid.centre_mm

    def tracked(frames):
        return s3.track(sweep.part(0, frames), curves).image

    whole = tracked(len(sweep))
    asked = [*range(2, len(sweep), step), len(sweep) - 1]
    with LiveTracker(sweep, curves, background=False) as live:
        given = [live.append(sweep.frames[k], float(k)).world_from_image for k in range(len(sweep))]
        live.revise()
        ended = live.poses
    held, later, part_later = [], [], []
    for k in asked:
        part = tracked(k + 1)[-1:]
        first = RigidTransform.concatenate([given[k]])
        held += apart_mm(first, part, centre).tolist()
        later += apart_mm(first, whole[k : k + 1], centre).tolist()
        part_later += apart_mm(part, whole[k : k + 1], centre).tolist()
    return held, later, part_later, apart_mm(ended, whole, centre)


def main():
    """Print a row for each sweep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("curves", type=Path)
    parser.add_argument("sweeps", type=Path, nargs="+")
    parser.add_argument("--step", type=int, default=4)
    given = parsed(parser, step=32)
    curves = s3.load_curves(given.curves)
    print("| sweep | first given, against the frames up to it: median | most | against the whole | ", end="")
    print("that part against the whole | at the end |")
    print("|---|---|---|---|---|---|")
    for path in given.sweeps:
        held, later, part_later, ended = row(path, curves, given.step)
        most = " | ".join(f"{max(each):.3f}" for each in (held, later, part_later, ended))
        print(f"| {path.stem} | {np.median(held):.3f} | {most} |", flush=True)


if __name__ == "__main__":
    main()
