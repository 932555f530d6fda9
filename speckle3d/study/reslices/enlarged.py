"""Cuts along the sweep enlarged, the tracker's alone beside the modes', as in figures 7 and 8 of [1]_.

References
----------
.. [1] R. J. Housden et al., "Calibration of an orientation sensor for freehand 3D ultrasound and its use in a
   hybrid acquisition system", BioMedical Engineering OnLine 7:5, 2008.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter1d

from speckle3d.core.arrays import Float32Array
from speckle3d.study.figures import (
    UNSEEN,
    colour_of,
    label_of,
    name_figure,
    new_figure,
    save_figure,
    show_grey,
)

DEEP_MM = 12.0
"""Depth that is shown: about as much as a short sweep is long."""

LONGEST_MM = 16.0

_PANEL_IN, _NARROWEST_IN = 3.4, 1.6
"""Height of a panel, and its least width, for its title."""
_RANGE_DB = 45.0
_BRIGHTEST_PERCENTILE = 99.7


def save_enlarged(cuts: Mapping[str, Float32Array], pixel_mm: float, name: str, path: Path) -> Path:
    """Draw the same part of the cut along a sweep at every mode's poses, enlarged, and write it as a PNG.

    Parameters
    ----------
    cuts : mapping of str to ndarray, shape (rows, columns)
        By mode ("tracker": the sensor's poses alone): echo in dB, NaN where nothing was seen. Rows go down in
        depth, columns along the sweep from the first frame on.
    pixel_mm : float
        Side of a pixel.
    name : str
        Of the sweep.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    reference = list(cuts.values())[-1]
    top = busiest_rows(reference, round(DEEP_MM / pixel_mm))
    rows = slice(top, top + round(DEEP_MM / pixel_mm))
    columns = slice(0, min(min(each.shape[1] for each in cuts.values()), round(LONGEST_MM / pixel_mm)))
    shown = {mode: image[rows, columns] for mode, image in cuts.items()}
    levels = np.concatenate([each.ravel() for each in shown.values()])
    seen = levels[np.isfinite(levels)]
    brightest = float(np.percentile(seen, _BRIGHTEST_PERCENTILE)) if seen.size else 0.0
    high, wide = next(iter(shown.values())).shape
    panel_in = (max(_PANEL_IN * wide / high, _NARROWEST_IN), _PANEL_IN)
    figure = new_figure(0.9 + len(shown) * (panel_in[0] + 0.25), panel_in[1] + 1.3, None)
    axes = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    extent = (0.0, wide * pixel_mm, (top + high) * pixel_mm, top * pixel_mm)
    for panel, (mode, image) in zip(axes, shown.items(), strict=True):
        show_grey(panel, image, extent, (brightest - _RANGE_DB, brightest))
        alone = mode == "tracker"
        colour = "black" if alone else colour_of(mode, list(shown))
        panel.set_title("tracker alone" if alone else label_of(mode), color=colour, parse_math=False)
        panel.set_xlabel("along the sweep / mm")
    axes[0].set_ylabel("depth / mm")
    width, height = figure.get_figwidth(), figure.get_figheight()
    borders = 0.75 / width, 0.55 / height, 1.0 - 0.15 / width, 1.0 - 0.75 / height
    figure.subplots_adjust(*borders, wspace=0.25 / panel_in[0])
    corner = 1.0 - 0.1 / width, 0.06 / height
    figure.text(*corner, "blue-grey: no frame", ha="right", fontsize="x-small", color=UNSEEN)
    name_figure(figure, f"{name}: part of the cut along the sweep, enlarged")
    return save_figure(figure, path)


def busiest_rows(image: Float32Array, count: int) -> int:
    """First of `count` rows in which structures along the sweep stand out most from speckle."""
    seen = image[np.isfinite(image)]
    if not seen.size:
        return 0
    smooth = uniform_filter1d(np.nan_to_num(image, nan=float(np.median(seen))), 15, axis=1)
    spread = smooth.var(axis=1)
    # Near the face the probe's own echo would win.
    first = min(count // 3, max(len(spread) - count, 0))
    sums = np.convolve(spread, np.ones(min(count, len(spread))), mode="valid")
    return first + int(np.argmax(sums[first:])) if len(sums) > first else 0
