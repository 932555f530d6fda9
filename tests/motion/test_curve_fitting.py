import numpy as np
import pytest
import speckle

from speckle3d.core.errors import InsufficientDataError
from speckle3d.motion.phantom import CurveSettings, PhantomSamples, fit_curves

DEPTHS_MM = (8.0, 16.0, 24.0)
WIDTHS_MM = (0.33, 0.5, 0.42)


def off_focus(d, sigma_mm):
    """A curve that starts steeper than a Gaussian and ends flatter, as two widths mixed do."""
    narrow, wide = (
        speckle.gaussian_correlation(d, 0.8 * sigma_mm),
        speckle.gaussian_correlation(d, 1.4 * sigma_mm),
    )
    return (0.6 * np.sqrt(narrow) + 0.4 * np.sqrt(wide)) ** 2


LAWS = [speckle.gaussian_correlation, speckle.triangle_correlation, off_focus]


def samples(law, distances, cells=np.inf, repeats=1):
    """Every distance at every depth, `repeats` times, with the scatter that so many cells leave."""
    rng = np.random.default_rng(0)
    depth = np.repeat(DEPTHS_MM, len(distances) * repeats)
    distance = np.tile(np.repeat(distances, repeats), len(DEPTHS_MM))
    width = np.interp(depth, DEPTHS_MM, WIDTHS_MM)
    rho = law(distance, width)
    scatter = 0.0 if np.isinf(cells) else (1 - rho**2) / np.sqrt(cells)
    rho = rho + scatter * rng.normal(size=rho.size)
    # Frames lie before and behind each other; none of these turn.
    offset = distance * rng.choice([-1.0, 1.0], distance.size)
    return PhantomSamples(depth, offset, np.zeros(depth.size), rho, len(distances) * repeats)


def read_distance(curves, correlation):
    """Distance at each depth for each correlation, shape (depth, correlation)."""
    rows = curves.at(np.array(DEPTHS_MM)).correlation
    return np.array(
        [np.interp(-c, -row, curves.distance_mm) for c, row in zip(correlation, rows, strict=True)]
    )


REGULAR = np.arange(0.0, 2.5, 0.1)
FREEHAND = np.sort(np.random.default_rng(3).uniform(0.0, 2.5, 400))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("distances", [REGULAR, FREEHAND], ids=["stepped", "freehand"])
def test_exact_samples_of_any_curve_give_its_distances_back(law, distances):
    curves = fit_curves(speckle.KEY, [samples(law, distances)])
    d = np.linspace(0.0, 2.5, 1001)
    for depth, width in enumerate(WIDTHS_MM):
        rho = law(d, width)
        useful = (rho < 0.9) & (rho > 0.15) & (d < d[np.argmin(rho > 0.1)])
        correlations = np.broadcast_to(rho[useful], (len(DEPTHS_MM), useful.sum()))
        distance = read_distance(curves, correlations)[depth]
        assert np.abs(distance / d[useful] - 1).max() < 0.02


@pytest.mark.parametrize("cells", [25, 100])
def test_cells_are_those_that_explain_the_scatter(cells):
    curves = fit_curves(
        speckle.KEY, [samples(speckle.gaussian_correlation, REGULAR[1:], cells=cells, repeats=100)]
    )
    # From the median of some 1000 deviations, itself known to 4 %, and squared; what is cut at the curve's
    # end adds as much again.
    np.testing.assert_allclose(curves.cells, cells, rtol=0.2)


@pytest.mark.parametrize(
    ("distances", "message"),
    [
        ([0.0, 0.5], "got 2 down to"),
        (np.arange(0.0, 0.2, 0.02), r"got \d down to 0\.\d\d"),
    ],
)
def test_too_few_distances_or_too_little_of_the_curve_are_refused(distances, message):
    with pytest.raises(InsufficientDataError, match=message) as error:
        fit_curves(speckle.KEY, [samples(speckle.gaussian_correlation, distances)])
    assert "\n" not in str(error.value)


def test_curves_end_where_the_phantom_did():
    curves = fit_curves(speckle.KEY, [samples(speckle.gaussian_correlation, np.arange(0.0, 0.56, 0.05))])
    assert curves.distance_mm[-1] == pytest.approx(0.55, abs=0.01)
    np.testing.assert_allclose(
        curves.correlation[:, -1],
        speckle.gaussian_correlation(curves.distance_mm[-1], np.array(WIDTHS_MM)),
        atol=5e-3,
    )
    whole = fit_curves(speckle.KEY, [samples(speckle.gaussian_correlation, REGULAR)])
    assert whole.distance_mm[-1] == pytest.approx(CurveSettings().largest_mm)
