"""Poses as ITK transforms, as SimpleITK reads them."""

import numpy as np
import SimpleITK
from sweep_examples import poses

from speckle3d.io.shapes.transforms import SUFFIX, transform_paths, write_transform, write_transforms

POINTS = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [3.0, -20.0, 7.0]])


def test_itk_takes_points_of_the_parent_to_the_image(tmp_path):
    """As in resampling; 3D Slicer shows the inverse as the transform to the parent."""
    pose = poses(3, seed=4)[1]
    write_transform(tmp_path / f"t{SUFFIX}", pose)
    transform = SimpleITK.ReadTransform(str(tmp_path / f"t{SUFFIX}"))
    assert transform.GetDimension() == 3
    assert transform.GetName() == "AffineTransform"
    for point in POINTS:
        back = transform.TransformPoint(pose.apply(point).tolist())
        np.testing.assert_allclose(back, point, atol=1e-12)


def test_a_file_for_each_frame(tmp_path):
    poses_ = poses(12)
    write_transforms(tmp_path / f"sweep{SUFFIX}", poses_)
    paths = transform_paths(tmp_path / f"sweep{SUFFIX}", 12)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)
    assert paths[11].name == f"sweep-0011{SUFFIX}"
    for path, pose in zip(paths, poses_, strict=True):
        transform = SimpleITK.ReadTransform(str(path)).TransformPoint([1.0, 2.0, 3.0])
        np.testing.assert_allclose(transform, pose.inv().apply([1.0, 2.0, 3.0]), atol=1e-12)
