"""Poses as ITK transforms, as SimpleITK reads them."""

import numpy as np
import SimpleITK
from sweep_examples import poses

from speckle3d.io.shapes import write_transform

POINTS = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [3.0, -20.0, 7.0]])


def test_itk_takes_points_of_the_parent_to_the_image(tmp_path):
    """As in resampling; 3D Slicer shows the inverse as the transform to the parent."""
    pose = poses(3, seed=4)[1]
    write_transform(tmp_path / "t.tfm", pose)
    transform = SimpleITK.ReadTransform(str(tmp_path / "t.tfm"))
    assert transform.GetDimension() == 3
    assert transform.GetName() == "AffineTransform"
    for point in POINTS:
        back = transform.TransformPoint(pose.apply(point).tolist())
        np.testing.assert_allclose(back, point, atol=1e-12)
