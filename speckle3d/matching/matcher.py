"""Prepare frames and match frame pairs of one sweep.

The in-plane shift comes from all patches together, and the correlation is read at that shift: taking each
patch's own maximum over lags biases the correlation upward and distances short.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy import fft

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray
from speckle3d.core.curves import CurveKey, DecorrelationCurves
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep
from speckle3d.core.threads import in_parallel
from speckle3d.kernels.inplane import Frame, Geometry, Matches, match_pair
from speckle3d.matching.intensity import Echo, IntensityExtractor, IntensitySettings, two_way_wavenumber
from speckle3d.matching.patches import PatchSettings, lay_patches
from speckle3d.matching.quality import FrameFeatures, QualitySettings, inspect_frame
from speckle3d.matching.table import CorrelationTable

_STANDING = 0.5
"""Share of a sample's power that is in the mean of the frames' echoes, from which it stands still. Of n
independent frames of speckle (1 - 0.5)^(n - 1) of the samples have it by chance."""

_UNCHANGED = 2.0
"""Ratio of the brightest to the darkest of a sample without phase, up to which it stands still: JPEG of
quality 75 changes text by as much. Of speckle in 16 frames across a sweep none is so even, in 12 neighbouring
ones 1 sample of 400."""

_OVERLAID, _OVER_SPECKLE = 0.1, 10.0
"""Share of a patch's power in samples that stand still, from which it is left out, also over that of the
median patch. Simulated sweeps of two physics have up to 0.009 where nothing stands, by chance; a white pixel
of text among a thousand has 0.1. On a probe that hardly moves speckle stays, but all over the image."""

_SILENT = 0.01
"""Power of a vector along a row of patches, over that of the row's brighter quarter, up to which it holds no
echo: -20 dB, where speckle has -6 dB at the least. Simulated tissue is silent in up to 0.3 % (vessels). Half
and twice of it move no length over tissue by more than 0.6 %, in RF or B-mode, in part in shadow or not."""


class MatchingSettings(BaseModel):
    """Settings of the correlation: complex echo or intensity."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    correlate: Literal["echo", "intensity"] = Field(
        "echo",
        description="echo: the complex echo, whose distances reach the Cramer-Rao bound and in which "
        "structure that stays weighs less. intensity: as published. B-mode images hold intensity alone.",
    )


class InPlaneSettings(BaseModel):
    """Settings of the search for in-plane motion."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    search_mm: float = Field(3.0, gt=0, description="Largest in-plane shift looked for between two frames.")
    least_overlap: float = Field(
        0.6, gt=0, le=1, description="Share of a patch that must still lie in the other image."
    )


class ImageSettings(BaseModel):
    """Settings of all stages that use images."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    intensity: IntensitySettings = IntensitySettings()
    patches: PatchSettings = PatchSettings()
    inplane: InPlaneSettings = InPlaneSettings()
    matching: MatchingSettings = MatchingSettings()
    quality: QualitySettings = QualitySettings()


class ReadyFrame(NamedTuple):
    """A frame as read, with its echo, features and matching data."""

    samples: npt.NDArray[Any]
    echo: Echo
    features: FrameFeatures
    frame: Frame


def standing_samples(echoes: Sequence[Echo]) -> BoolArray:
    """Samples that stand still in frames far apart, by the echo's mean or by their level.

    Text, a ruler, ringing without contact: they tell nothing of the motion. In the others' local mean they
    would be a pattern that stays, as if the probe had moved less.
    """
    intensities = np.stack([echo.intensity for echo in echoes])
    analytic = [echo.analytic for echo in echoes if echo.analytic is not None]
    if analytic:
        return np.asarray(np.abs(np.mean(analytic, axis=0)) ** 2 > _STANDING * intensities.mean(axis=0))
    darkest, brightest = intensities.min(axis=0), intensities.max(axis=0)
    return np.asarray((brightest <= _UNCHANGED * darkest) & (darkest > np.min(darkest)))


class FrameMatcher:
    """Prepares the frames of one sweep and matches pairs of them.

    Parameters
    ----------
    sweep : Sweep
        Whose frames are not read.
    settings : ImageSettings, optional
    curves : DecorrelationCurves, optional
        To whose depths the patches are kept, and whose dynamic range is taken where the sweep's is estimated.

    Attributes
    ----------
    signal : RFSettings or BModeSettings
    quality : QualitySettings
    laid, patches : PatchGrid
        All that fit on the image, and those that are matched.
    overlaid : ndarray of bool, shape (p,)
        Patches on which something stands still, which are left out.

    Raises
    ------
    MismatchError
        If the curves belong to another probe, frequency, sampling, patch size or depth.
    """

    def __init__(
        self,
        sweep: Sweep,
        settings: ImageSettings | None = None,
        curves: DecorrelationCurves | None = None,
    ) -> None:
        s, signal = settings or ImageSettings(), sweep.signal
        reference = None if curves is None else curves.key.signal
        if isinstance(signal, BModeSettings) and isinstance(reference, BModeSettings):
            is_estimated = signal.dynamic_range_sigma_db > 0
            signal = replace(reference, full_scale=signal.full_scale) if is_estimated else signal
        self.signal, self.quality = signal, s.quality
        self.extractor = IntensityExtractor(signal, sweep.grid, s.intensity)
        self.grid = self.extractor.grid
        self.centre_mm = sweep.grid.centre_mm
        self.patches = self.laid = lay_patches(self.grid, s.patches)
        self._least_overlap = s.inplane.least_overlap
        self._counted = self.laid.region
        spacing, sides = self.laid.spacing_mm, np.array([self.grid.vectors, self.grid.samples])
        rf = signal if isinstance(signal, RFSettings) else None
        # Of echoes two samples are pooled for the coarse search: speckle has four, and matching goes on from
        # the peak's sample.
        self._pool = np.array([1, 1 if rf is None else 2])
        reach = np.ceil(s.inplane.search_mm / (spacing * self._pool))
        self._reach = np.minimum(reach, sides // self._pool - 1).astype(np.int64)
        self._lengths = [fft.next_fast_len(int(n), True) for n in sides // self._pool + self._reach]
        self.of_echo = rf is not None and s.matching.correlate == "echo"
        self._wavenumber, fan = two_way_wavenumber(rf) if rf is not None else 0.0, sweep.grid.fan
        lines = ("parallel", 0.0, 0.0) if fan is None else ("fan", fan.radius_mm, fan.step_rad)
        self.key = CurveKey(
            signal,
            self.grid.vector_pitch_mm,
            s.patches.width_mm,
            s.patches.height_mm,
            s.intensity.equalise_mm,
            "echo" if self.of_echo else "intensity",
            s.intensity.edge_fraction,
            sweep.probe,
            *lines,
        )
        if curves is not None:
            curves.key.require_same(self.key)
            self.patches = self.laid.between(curves.depth_mm)
        self.overlaid = np.zeros(len(self.patches), dtype=bool)

    def leave_out(self, echoes: Sequence[Echo]) -> None:
        """Leave out the patches on which something stands still in some frames, and that from local means."""
        echoes = [echo for echo in echoes if np.isfinite(echo.intensity.sum()) and echo.intensity.any()]
        if not echoes:
            return
        standing = standing_samples(echoes)
        total = np.sum([echo.intensity for echo in echoes], axis=0)
        still, power = (self.patches.tiles(part).sum(axis=(1, 2)) for part in (standing * total, total))
        share = still / np.maximum(power, np.finfo(np.float32).tiny)
        self.overlaid = share > max(_OVERLAID, _OVER_SPECKLE * float(np.median(share)))
        self._counted = self.laid.region & ~(standing & self.overlaid.any())

    def ready(self, samples: npt.NDArray[Any]) -> ReadyFrame:
        """Make a frame, as read, ready to be matched; on any thread."""
        echo, patches = self.extractor.echo(samples), self.patches
        silent = self._silent(echo.intensity)
        features = inspect_frame(
            samples, echo.intensity, patches, isinstance(self.signal, BModeSettings), self.quality
        )
        echoing = 1.0 - patches.tiles(silent).mean(axis=(1, 2)) if silent.any() else 1.0
        usable = features.usable & ~self.overlaid & (echoing >= self._least_overlap)
        frame = self.prepare(echo, usable, self._counted & ~silent)
        return ReadyFrame(samples, echo, replace(features, usable=usable), frame)

    def _silent(self, intensity: Float32Array) -> BoolArray:
        """Samples in rows of patches whose vector holds no echo there: a shadow, no contact."""
        high, silent = self.patches.size[1], np.zeros(intensity.shape, dtype=bool)
        for top in np.unique(self.patches.first[:, 1]):
            power = intensity[:, top : top + high].mean(axis=1)
            silent[:, top : top + high] = (power < _SILENT * np.sort(power)[3 * power.size // 4])[:, None]
        return silent

    def prepare(self, echo: Echo, usable: BoolArray, counted: BoolArray) -> Frame:
        """Equalise an echo and transform it for the coarse search.

        Parameters
        ----------
        usable : ndarray of bool, shape (p,)
            Patches that may be matched.
        counted : ndarray of bool, shape (vector, grid.samples)
            Samples that may.
        """
        echo = echo if self.of_echo else echo._replace(analytic=None)
        image, parts = self.extractor.equalised(echo, counted)
        pool = int(self._pool[1])
        end = image.shape[1] // pool * pool
        pooled = np.add.reduce([image[:, first:end:pool] for first in range(pool)])
        spectrum = fft.rfft2(pooled - pooled.mean(), self._lengths)
        return Frame(usable, image, parts, spectrum)

    def search(self, fixed: Frame, moving: Frame) -> FloatArray:
        """In-plane motion (x, y, roll) to the nearest sample, by the correlation of whole frames."""
        rows, columns = self._reach
        product = np.conj(fixed.spectrum) * moving.spectrum
        product = fft.ifft(product, axis=0, overwrite_x=True)[np.arange(-rows, rows + 1)]
        near = fft.irfft(product, self._lengths[1], axis=1)[:, np.arange(-columns, columns + 1)]
        peak = np.array(np.unravel_index(np.argmax(near), near.shape))
        shift = (peak - self._reach) * self._pool * self.patches.spacing_mm
        return np.array([*-shift, 0.0])

    def match(
        self, fixed: Mapping[int, Frame], number: int, moving: Frame, starts: Sequence[FloatArray]
    ) -> CorrelationTable:
        """In-plane motion and correlation of a frame's pairs with some earlier ones.

        Parameters
        ----------
        fixed : mapping of int to Frame
            The others, by their numbers.
        number, moving : int and Frame
        starts : sequence of ndarray, shape (3,)
            Motion from each of the others, right to about a sample.
        """
        count, patches = len(fixed), self.patches
        places = patches.centre_mm - self.centre_mm[:2]
        geometry = Geometry(
            patches.first,
            patches.size,
            np.column_stack([np.ones(len(patches)), places]),
            np.column_stack([patches.pitch_mm, np.full(len(patches), patches.spacing_mm[1])]),
            np.column_stack([np.sin(patches.angle_rad), np.cos(patches.angle_rad)]),
            patches.step_rad,
            self._least_overlap,
            self._wavenumber,
        )
        matches = Matches(
            np.empty((count, len(patches))), np.array(starts).reshape(count, 3), np.empty((count, 3, 3))
        )
        frames = list(fixed.values())

        def match(begin: int, stop: int) -> None:
            for row in range(begin, stop):
                match_pair(frames[row], moving, geometry, matches, row)

        in_parallel(match, count)
        first = np.array(list(fixed), dtype=np.int64)
        correlation = matches.correlation.astype(np.float32)
        return CorrelationTable(first, np.full(count, number), correlation, *matches[1:])


def compose(first: FloatArray, second: FloatArray) -> FloatArray:
    """In-plane motion (x, y, roll) over two steps, as a start for matching across both."""
    place = complex(*first[:2]) + np.exp(1j * first[2]) * complex(*second[:2])
    return np.array([place.real, place.imag, first[2] + second[2]])


def inverse(motion: FloatArray) -> FloatArray:
    """In-plane motion the other way round."""
    place = -np.exp(-1j * motion[2]) * complex(*motion[:2])
    return np.array([place.real, place.imag, -motion[2]])
