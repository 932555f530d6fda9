import numpy as np
import pytest

from speckle3d.kernels.quality import patch_statistics


def statistics(image, first, size):
    out = np.full((len(first), 5), -9.0)
    patch_statistics(np.asarray(image, np.float32), np.array(first), np.array(size), out)
    return out


def pearson(a, b):
    return np.corrcoef(a.ravel(), b.ravel())[0, 1]


@pytest.mark.parametrize("size", [(3, 3), (6, 40), (7, 87)])
@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e12])
def test_they_are_numpys_whatever_the_gain(size, scale):
    first = [(0, 0), (2, 5), (23 - size[0], 101 - size[1])]
    rng = np.random.default_rng(0)
    image = rng.exponential(size=(23, 101)) + rng.exponential(size=(23, 1)) + rng.exponential(size=101)
    image = (scale * image).astype(np.float32)
    for got, (v, s) in zip(statistics(image, first, size), first, strict=True):
        patch = image[v : v + size[0], s : s + size[1]].astype(float)
        wide, high = size[0] // 2, size[1] // 2
        assert got[0] == pytest.approx(patch.mean(), rel=1e-6)
        assert got[1:].tolist() == pytest.approx(
            [
                patch.std() / patch.mean(),
                pearson(patch[:-1], patch[1:]),
                pearson(patch[:wide], patch[-wide:]),
                pearson(patch[:, :high], patch[:, -high:]),
            ],
            abs=2e-6,
        )


def test_flat_empty_and_spoilt_patches():
    image = np.ones((18, 10), np.float32)
    image[6:12] = 0.0
    image[13, 4] = np.inf
    flat, empty, spoilt = statistics(image, [(0, 0), (6, 0), (12, 0)], (6, 10))
    assert (flat[0], flat[1]) == (1.0, 0.0)
    assert np.isnan(flat[2:]).all()
    assert empty[0] == 0.0
    assert np.isnan(empty[1:]).all()
    assert np.isinf(spoilt[0])
    assert np.isnan(spoilt[1:]).all()
