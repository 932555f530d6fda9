"""Parts of the reconstruction viewer without a browser."""

import shlex
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.app.folder import Folder
from speckle3d.app.reconstruction.commands import measure_command, reslice_command
from speckle3d.app.reconstruction.cuts.material import KeptImages, Material
from speckle3d.app.reconstruction.cuts.newest import Newest
from speckle3d.app.reconstruction.cuts.shown import NAMES, Shown, cut_of_voxels
from speckle3d.app.reconstruction.measuring import Picked
from speckle3d.app.reconstruction.page import ReconstructionPage
from speckle3d.app.reconstruction.space import RADIUS_95, band, ellipsoid
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.reconstruction import Provenance, Reconstruction, Trust
from speckle3d.core.sweep import BModeSettings, ImageGrid, Sweep
from speckle3d.study.figures import RANGE_DB
from speckle3d.study.pose_errors import measure
from speckle3d.study.reslices.cuts import cut_posed

GRID = ImageGrid(vectors=32, samples=40, vector_pitch_mm=0.5, sample_spacing_mm=0.5)
FRAMES = 24


@pytest.fixture(scope="module")
def made():
    """A sweep of smooth speckle with two modes, of which one is 5 % longer."""
    z = 0.4 * np.arange(FRAMES)
    x, y = np.meshgrid(np.arange(32) * 0.5, np.arange(40) * 0.5, indexing="ij")
    images = [128 + 60 * np.sin(x / 2 + 0.3 * k) * np.cos(y / 3 + 0.1 * k) for k in range(FRAMES)]
    signal = BModeSettings(dynamic_range_db=60.0)
    sweep = Sweep(np.rint(images).astype(np.uint8), GRID, signal, z / 10, name="smooth")
    poses = {
        mode: RigidTransform.from_translation(np.outer(scale * z, [0.0, 0.0, 1.0]))
        for mode, scale in (("image", 1.0), ("pose", 1.05))
    }
    covariance = np.array([np.diag([0.01, 0.02, 0.05 * k + 1e-3, 1e-5, 1e-5, 1e-5]) for k in range(FRAMES)])
    trust = Trust(covariance, np.zeros(FRAMES, dtype=np.int64))
    return Reconstruction(
        sweep.frame_time_s, GRID, poses, Provenance("smooth.h5", "", ""), trust=trust
    ), sweep


@pytest.fixture(scope="module")
def material(made):
    material, done = Material(*made), threading.Event()
    for mode in ("image", "pose"):
        done.clear()
        material.ask_for_voxels(mode, lambda mode, share: done.set() if share == 1.0 else None)
        assert done.wait(60)
    return material


def test_only_the_newest_request_is_worked_on():
    begun, go, worked = threading.Event(), threading.Event(), []

    def work(request):
        begun.set()
        go.wait(5)
        worked.append(request)

    newest = Newest(work)
    newest.ask(1)
    begun.wait(5)
    for request in (2, 3, 4):
        newest.ask(request)
    assert newest.has_newer
    go.set()
    for _ in range(200):
        if worked == [1, 4]:
            break
        time.sleep(0.01)
    assert worked == [1, 4]


def test_kept_images_are_made_once_and_bounded():
    made = []

    def image(index):
        made.append(index)
        return np.full((10, 10), index, np.float32)

    kept = KeptImages(image, 5, most_bytes=3 * 400)
    for index in (0, 1, 2, 0, 1, 2):
        assert kept[index][0, 0] == index
    assert made == [0, 1, 2]
    assert [kept[index][0, 0] for index in (3, 0)] == [3, 0]
    assert made == [0, 1, 2, 3, 0]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("other", [None, "pose"])
def test_cuts_of_voxels_are_those_of_the_frames_but_coarser(material, name, other):
    shown = Shown("image", other, frame=12, lateral_mm=8.0, depth_mm=9.0)
    place = shown.place(name, material.axes("image"), material)
    opened = material.opened(*shown.modes)
    voxels = {mode: material.voxels(mode) for mode in shown.modes}
    quick = cut_of_voxels(opened, place, material, voxels)
    fine = cut_posed(opened, place, RANGE_DB, made=material.images())
    assert list(quick.cuts) == list(fine.cuts)
    for mode, drawn in fine.cuts.items():
        both = np.isfinite(drawn.image) & np.isfinite(quick.cuts[mode].image)
        assert both.mean() > 0.8
        assert np.abs(drawn.image - quick.cuts[mode].image)[both].mean() < 1.0  # dB, of a swing of 28


def test_picked_points_are_measured_as_they_are_written(made):
    reconstruction, _ = made
    picked = Picked("image")
    for point in ([2.00004, 3.0, 1.0], [9.0, 14.0, 6.0]):
        picked = picked.with_point(np.array(point), reconstruction)
    words = shlex.split(measure_command(Path("a b.h5"), "image", picked.points_mm))
    assert words[:5] == ["speckle3d", "measure", "a b.h5", "--mode", "image"]
    written = [[float(each) for each in word.split(",")] for word in words[6::2]]
    assert picked.measured(reconstruction)[0] == measure(reconstruction, np.array(written))[0].line
    with pytest.raises(InvalidInputError, match="point in the sweep"):
        picked.with_point(np.array([0.0, 0.0, 99.0]), reconstruction)
    with pytest.raises(InvalidInputError, match="truth"):
        Picked("truth").with_point(np.zeros(3), reconstruction)


def test_commands_name_what_is_shown(material):
    shown = Shown("image", "pose", frame=7)
    words = shlex.split(
        reslice_command(
            Path("r.h5"),
            "o.png",
            shown,
            shown.place("frame", material.axes("image"), material),
            Path("/s.h5"),
        )
    )
    assert words == [
        "speckle3d", "reslice", "r.h5", "-o", "o.png", "--mode", "image", "--mode", "pose",
        "--difference-to", "image", "--frame", "7", "--reach-mm", "0.8", "--sweep", "/s.h5",
    ]  # fmt: skip
    assert "--outlines" in shlex.split(reslice_command(Path("r.h5"), "o.png", shown, None))


def test_bands_hold_95_percent():
    rng = np.random.default_rng(3)
    spread = np.diag([0.5, 1.0, 2.0])
    drawn = rng.multivariate_normal(np.zeros(3), spread, 20_000)
    share = (np.einsum("ka,ab,kb->k", drawn, np.linalg.inv(spread), drawn) < RADIUS_95**2).mean()
    assert share == pytest.approx(0.95, abs=0.006)
    vertices, _ = ellipsoid(np.array([1.0, 2.0, 3.0]), spread)
    away = vertices - [1.0, 2.0, 3.0]
    np.testing.assert_allclose(np.einsum("ka,ab,kb->k", away, np.linalg.inv(spread), away), RADIUS_95**2)
    path = np.outer(np.arange(5.0), [0, 0, 1])
    rings, triangles = band(path, np.broadcast_to(spread, (5, 3, 3)))
    np.testing.assert_allclose(np.abs(rings).max(axis=0)[:2], RADIUS_95 * np.sqrt([0.5, 1.0]), rtol=0.05)
    assert triangles.max() == len(rings) - 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_without_a_server_it_is_drawn_to_a_document(made, tmp_path):
    from bokeh.document import Document

    document = Document()
    ReconstructionPage(*made, Folder(tmp_path / "reconstruction.h5")).view().server_doc(document)
    assert {"cut-along", "cut-frame", "cut-depth", "cut-free", "bands"} <= {
        model.name for root in document.roots for model in root.references()
    }
