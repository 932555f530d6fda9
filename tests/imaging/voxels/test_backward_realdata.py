"""Withheld images of a real tracked sweep, 1.6 mm apart, predicted from the others."""

import numpy as np
import pytest

from speckle3d.core.labels import FILLED
from speckle3d.imaging.axes import sweep_axes
from speckle3d.imaging.images import ChosenImages, PosedImages
from speckle3d.imaging.voxels.grid import grid_around
from speckle3d.imaging.voxels.volume import compound
from speckle3d.io.import_settings import ImportSettings
from speckle3d.study.posed import open_posed

pytestmark = pytest.mark.realdata


def test_between_sparse_images_interpolation_is_nearer_to_the_truth_than_filling(realdata):
    folder = realdata / "plus"
    config = folder / "PlusDeviceSet_VolumeReconstructionOnly_SpinePhantom_NN_MEAN.xml"
    posed = open_posed(
        folder / "SpinePhantomFreehand.igs.mha", settings=ImportSettings(plus_config=str(config))
    )
    source, _ = posed.source()
    kept = np.arange(0, len(source), 2)
    sparse = PosedImages(ChosenImages(source.images, kept), source.grid, source.world_from_image[kept])
    voxel_grid = grid_around(source.grid, source.world_from_image, 0.6, sweep_axes(source.world_from_image))
    place = sparse.images, sparse.grid, sparse.world_from_image
    backward = compound(*place, voxel_grid=voxel_grid, backward_mm=5.0)
    filled = compound(*place, voxel_grid=voxel_grid, fill_radius=6)
    errors = []
    for number in range(1, len(source) - 1, 2):
        image = source.read(number)[::4, ::4]
        sample = np.stack(
            [*np.mgrid[: source.grid.vectors : 4, : source.grid.samples : 4], np.ones(image.shape)], -1
        )
        points = source.world_from_image[number].apply(
            sample.reshape(-1, 3) @ source.grid.image_from_sample[:3].T
        )
        index = np.rint(voxel_grid.world_from_grid.inv().apply(points) / voxel_grid.spacing_mm).astype(int)
        inside = ((index >= 0) & (index < voxel_grid.shape)).all(axis=1)
        at, level = tuple(index[inside].T), image.ravel()[inside]
        # Where both had to work it out, and the image shows anything: beside the fan it is black.
        unseen = (backward.state[at] == FILLED) & (filled.state[at] == FILLED) & (level > 0)
        both = np.abs([backward.voxels[at] - level, filled.voxels[at] - level])
        errors.append(both[:, unseen])
    apart = np.concatenate(errors, axis=1)
    assert apart.shape[1] > 5e4
    # 14.7 against 15.5 of 255 grey levels.
    assert apart[0].mean() < 0.97 * apart[1].mean()
