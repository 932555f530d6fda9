"""What dragging the free plane of the reconstruction viewer takes on the server: from message to cut.

Run: python tests/benchmarks/bench_free_plane.py RECONSTRUCTION.h5
"""

import sys
import threading
import time
from pathlib import Path

import numpy as np

from speckle3d.app.folder import Folder
from speckle3d.app.reconstruction.cuts.free_plane import FreePlane
from speckle3d.app.reconstruction.cuts.material import Material
from speckle3d.app.reconstruction.viewer import Viewer
from speckle3d.study.images import open_reconstruction

DRAGS = 200


def main(path):
    material = Material(*open_reconstruction(path))
    made = threading.Event()
    material.ask_for_voxels(material.modes[0], lambda mode, share: made.set() if share == 1.0 else None)
    made.wait(600)
    viewer = Viewer(material, Folder(path), None)
    viewer.view()
    time.sleep(5)  # cuts from the frames
    shown = threading.Event()
    show = viewer._cuts.show_cut

    def told(name, picture, is_fine):
        show(name, picture, is_fine)
        if name == "free" and not is_fine:
            shown.set()

    viewer._cuts.show_cut = told
    viewer._once = lambda act, after_ms: act() if act == viewer._draw else None
    took = []
    for k in range(DRAGS):
        shown.clear()
        began = time.perf_counter()
        viewer.change(plane=FreePlane(4 * np.sin(0.1 * k), 45 + k, 20 * np.cos(0.07 * k)))
        assert shown.wait(10)
        took.append(1000 * (time.perf_counter() - began))
        time.sleep(0.02)
    voxels = material.voxels(material.modes[0])
    print(f"{voxels.shape} voxels of {voxels.spacing_mm[0]:g} mm; {DRAGS} moves of the free plane")
    print(
        f"server, ms: median {np.median(took):.1f}, 95 % {np.percentile(took, 95):.1f}, most {max(took):.1f}"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
