"""Volumes of a real tracked sweep beside those that PLUS made of it.

PLUS's are made again to the last voxel by a twin of its arithmetic. What lies between them and ours is then
taken apart step by step: its means are kept in whole grey levels, its places are multiples of 2^-14 voxel,
its holes are filled along sticks. Bounds are what was measured, with room for rounding of another machine.
"""

import re
from dataclasses import dataclass
from functools import cached_property

import igsio_twin
import numpy as np
import pytest
from commands import run_command
from igsio_twin import Clip

from speckle3d.core.labels import FILLED, MEASURED
from speckle3d.imaging.voxels.grid import grid_like
from speckle3d.imaging.voxels.volume import compound
from speckle3d.io.import_settings import ImportSettings
from speckle3d.io.volumes import read_volume
from speckle3d.study.posed import open_posed

pytestmark = pytest.mark.realdata

SPACING_MM = 0.5
WIDTH, HEIGHT = 820, 616

CLIPS = {"NN": Clip((0, 820), (0, 616)), "LN": Clip((192, 612), (16, 596), (380, 20, 120, 360, -45, 45))}
"""Of ``PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN`` and ``..._SonixRP_TRUS_D70mm_LN_MEAN``,
which its tests make the two volumes with; the second's fan is that of ``..._NN_LATE``."""


@dataclass
class Case:
    """A volume of PLUS, the images it was made of, and where they lie in it."""

    name: str
    images: np.ndarray
    reference: np.ndarray
    header_origin: np.ndarray
    reference_from_image: np.ndarray

    @property
    def clip(self):
        return CLIPS[self.name]

    @property
    def linear(self):
        return self.name == "LN"

    def maps(self, origin):
        """Affine maps from (column, row, 0, 1) to voxel indices."""
        maps = self.reference_from_image[:, :3].copy()
        maps[:, :, 3] -= origin
        return maps / SPACING_MM

    def own_origin(self):
        return igsio_twin.grid_of(self.reference_from_image, self.clip, WIDTH, HEIGHT, SPACING_MM)

    def paste(self, point=igsio_twin.POINT, rule="mean"):
        """Volume and weights as PLUS has them before it fills holes."""
        origin, shape = self.own_origin()
        maps = self.maps(origin if point == igsio_twin.POINT else self.header_origin)
        return igsio_twin.paste(self.images, maps, shape, self.clip, self.linear, rule, point)

    @cached_property
    def pasted(self):
        return self.paste()

    @cached_property
    def mean(self):
        """Mean and weight without rounding, at PLUS's places."""
        origin, shape = self.own_origin()
        return igsio_twin.exact_mean(self.images, self.maps(origin), shape, self.clip, self.linear)

    @cached_property
    def true_mean(self):
        """The same at the places that the header and the poses give."""
        maps, shape = self.maps(self.header_origin), self.reference.shape
        return igsio_twin.exact_mean(self.images, maps, shape, self.clip, self.linear, true_places=True)


def matrix(text):
    return np.array(text.split(), dtype=float).reshape(4, 4)


def device_set(folder):
    return folder / "PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN.xml"


def reference_path(folder, name):
    return folder / f"vtkVolumeReconstructorTest{name}MEANvolumeRef.mha"


@pytest.fixture(scope="module", params=["NN", "LN"])
def case(request, realdata):
    sitk, folder = pytest.importorskip("SimpleITK"), realdata / "plus"
    config = device_set(folder).read_text()
    sweep = sitk.ReadImage(folder / "SpinePhantomFreehand.igs.mha")
    plus = sitk.ReadImage(reference_path(folder, request.param))
    images = sitk.GetArrayFromImage(sweep)
    held = [f"Seq_Frame{i:04d}_{{}}ToTrackerTransform" for i in range(len(images))]
    probe, reference = (
        np.array([matrix(sweep.GetMetaData(name.format(tool))) for name in held])
        for tool in ("Probe", "Reference")
    )
    probe_from_image = matrix(re.search(r'From="Image" To="Probe"\s+Matrix="([^"]*)"', config)[1])
    voxels = sitk.GetArrayFromImage(plus).transpose(2, 1, 0)
    placed = np.linalg.inv(reference) @ probe @ probe_from_image
    return Case(request.param, images, voxels, np.array(plus.GetOrigin()), placed)


@pytest.fixture(scope="module")
def compounded(case, realdata):
    """Makes our volume of the same images on the same grid."""
    folder = realdata / "plus"
    settings = ImportSettings(plus_config=str(device_set(folder)))
    source, meaning = open_posed(folder / "SpinePhantomFreehand.igs.mha", settings=settings).source()
    assert meaning == "B-mode as stored, 0 to 255"
    grid = grid_like(read_volume(reference_path(folder, case.name)))
    how = {"splat": "linear" if case.linear else "nearest", "region": case.clip.mask(WIDTH, HEIGHT).T}
    images = source.images, source.grid, source.world_from_image
    return lambda radius=0, **more: compound(*images, voxel_grid=grid, fill_radius=radius, **how, **more)


@pytest.fixture(scope="module")
def ours(compounded):
    """Our volumes without and with filled holes."""
    return [compounded(0), compounded(3)]


def share_within(levels, ours, theirs, where):
    return (np.abs(ours[where].astype(float) - theirs[where]) <= levels).mean()


def test_the_twin_makes_the_volumes_of_plus_to_the_last_voxel(case):
    origin, shape = case.own_origin()
    np.testing.assert_allclose(origin, case.header_origin, atol=6e-4)  # six digits in the header
    assert shape == case.reference.shape
    filled = igsio_twin.fill_with_sticks(*case.pasted)
    np.testing.assert_array_equal(filled, case.reference)


def test_ours_is_the_mean_of_the_same_pixels_at_their_true_places(case, ours):
    mean, weight = case.true_mean
    measured = ours[0].state == MEASURED
    # A pixel on the side of a voxel may fall either way: poses are made rigid, 1e-4 mm off the written ones.
    assert (measured != (weight > 0)).sum() < 100
    both = measured & (weight > 0)
    assert share_within(0.5, ours[0].voxels, mean, both) > 0.998
    assert share_within(2, ours[0].voxels, mean, both) > 0.9995


def test_rounding_is_what_plus_does_to_the_mean(case):
    _, weight = case.pasted
    mean, share = case.mean
    measured = weight > 0
    off = case.reference[measured] - mean[measured]
    lit = measured & (case.reference > 0)
    if case.linear:
        # Rounded after every pixel, a mean moves no more once pixels differ by less than half their number.
        lost = (share > 0) & ~measured
        assert lost.sum() == pytest.approx(6806, abs=50)
        assert share[lost].max() < 0.02  # single weights below 1/512 are lost, a few of them in a voxel
        assert off.mean() == pytest.approx(0.79, abs=0.02)
        assert (np.abs(off) <= 2.5).mean() == pytest.approx(0.616, abs=0.01)
        return
    np.testing.assert_array_equal(measured, share > 0)
    # Cut after every pixel, it can only fall: by 4.8 levels where there is an image, by up to 17.
    assert off.max() < 1e-9
    assert (mean - case.reference)[lit].mean() == pytest.approx(4.83, abs=0.02)
    assert off.min() == pytest.approx(-16.8, abs=0.1)
    few = measured & (share < 5)
    assert share_within(2, mean, case.reference, few) == 1.0
    assert (np.abs(off) <= 2.5).mean() == pytest.approx(0.694, abs=0.01)


def test_its_places_alone_keep_its_own_means_from_agreeing_with_it(case):
    """Of true places, PLUS's arithmetic itself makes another volume than PLUS: by 2 levels in 1 to 2 %."""
    volume, weight = case.pasted
    placed, true_weight = case.paste(point=24)
    both = (weight > 0) & (true_weight > 0)
    expected = 0.990 if case.linear else 0.980
    assert share_within(2, placed, volume, both) == pytest.approx(expected, abs=0.003)


def test_the_maximum_is_that_of_plus_at_true_places(case, compounded):
    volume, weight = case.paste(point=24, rule="maximum")
    ours = compounded(rule="maximum", voxel_type="uint8")
    both = (ours.state == MEASURED) & (weight > 0)
    assert both.sum() > 0.99 * max((weight > 0).sum(), (ours.state == MEASURED).sum())
    assert share_within(0, ours.voxels, volume, both) > (0.995 if case.linear else 0.999)


def test_ours_beside_plus(case, ours):
    """What a user finds who compares them: the same image, PLUS's means rounded as the tests above say."""
    _, weight = case.pasted
    both = (ours[0].state == MEASURED) & (weight > 0)
    levels = np.rint(ours[0].voxels)
    assert np.corrcoef(levels[both], case.reference[both])[0, 1] > 0.997
    expected = 0.610 if case.linear else 0.686
    assert share_within(2, levels, case.reference, both) == pytest.approx(expected, abs=0.01)
    if not case.linear:
        same = case.true_mean[1] == weight / igsio_twin.ONE_PIXEL
        few = both & same & (weight <= 4 * igsio_twin.ONE_PIXEL)
        assert few.sum() > 10_000
        assert share_within(2, levels, case.reference, few) > 0.99


def test_holes_resemble_those_plus_fills_with_sticks(case, ours):
    _, weight = case.pasted
    holes = (ours[1].state == FILLED) & (weight == 0) & (case.reference > 0)
    assert holes.sum() > 3e4
    # Another way of filling (between two voxels along a line, not the mean of a cube's): alike, not equal.
    assert np.corrcoef(ours[1].voxels[holes], case.reference[holes])[0, 1] > 0.96
    np.testing.assert_array_equal(
        ours[1].voxels[ours[1].state == MEASURED], ours[0].voxels[ours[0].state == MEASURED]
    )


def region_of(clip, image_from_pixel):
    """The clip's rectangle and fan for --region: polygons, as pixels are not square, nor their axes."""
    x, top, inner, outer, _, side = clip.fan
    reach = np.cos(np.deg2rad(side))  # of a radius, where it meets the sides at 45 degrees
    far, near = (np.linspace(radius * reach, radius, 40) for radius in (outer, inner))
    far_half, near_half = (np.sqrt(np.maximum(r**2 - y**2, 0)) for r, y in ((outer, far), (inner, near)))
    # Pixels less than one from the sides do not count.
    ways = [(x - 1 + far_half, far), (x + 1 - far_half[::-1], far[::-1])]
    ways += [(x + 1 - near_half, near), (x - 1 + near_half[::-1], near[::-1])]
    columns, down = (np.concatenate(each) for each in zip(*ways, strict=True))
    rectangle = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    corners = np.stack([clip.columns, clip.rows])[[0, 1], rectangle]
    words = ["polygon"]
    for points in (corners, np.stack([columns, top + down], axis=1)):
        placed = points @ image_from_pixel[:2, :2].T + image_from_pixel[:2, 2]
        words += [f"{a:.6f},{b:.6f}" for a, b in placed] + ["and", "polygon"]
    return " ".join(words[:-2])


@pytest.mark.slow
def test_the_command_makes_the_same_volume(case, ours, realdata, tmp_path):
    folder, out = realdata / "plus", tmp_path / "volume.mha"
    settings = ImportSettings(plus_config=str(device_set(folder)))
    grid = open_posed(folder / "SpinePhantomFreehand.igs.mha", settings=settings).source()[0].grid
    fan = (
        ("--splat", "linear", "--region", region_of(case.clip, grid.image_from_sample)) if case.linear else ()
    )
    run_command(
        "volume", folder / "SpinePhantomFreehand.igs.mha", "--plus-config", device_set(folder), *fan,
        "--like", reference_path(folder, case.name), "--fill-radius", 0, "--voxel-type", "float32", "-o", out,
    )  # fmt: skip
    made = read_volume(out)
    assert made.fields["levels"] == "B-mode as stored, 0 to 255"
    if case.linear:  # single pixels on the fan's sides may fall either way
        measured = (ours[0].state == MEASURED) & ~np.isnan(made.voxels)
        assert measured.sum() > 0.99 * max((ours[0].state == MEASURED).sum(), (~np.isnan(made.voxels)).sum())
        assert share_within(0.1, made.voxels, ours[0].voxels, measured) > 0.98
        assert share_within(2, made.voxels, ours[0].voxels, measured) > 0.99
    else:
        np.testing.assert_array_equal(made.voxels, ours[0].voxels)
