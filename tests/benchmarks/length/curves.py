"""Lengths read with curves that nobody measured on a phantom of the sweep's own probe."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from cache import DEFAULT
from speckle3d.motion.corrected_curves import corrected_curves

from length.rows import Row
from length.scenes import borrowed_curves, crossing_pair
from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.sweep import Sweep
from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.matching.blocks import Block, MatchedBlock, blocks_of
from speckle3d.motion.data_sheet import ProbeSheet
from speckle3d.pipeline import Tracked, match_ahead, track
from speckle3d.sheet_curves import data_sheet_curves
from speckle3d.tracked_curves import tracker_scale

OWN = Path(__file__).resolve().parents[3] / "data" / "curves.h5"
FOCI_MM = 17.0, 20.0, 23.0
"""Of the data sheet; the probe's lens focuses at 20 mm."""
CROSSING_SIGMA = 0.01
"""Error of a known length, in place of a crossing's."""


class Scan:
    """A sweep whose frames are matched once, for any curves."""

    def __init__(self, path: Path, curves: DecorrelationCurves) -> None:
        self.sweep: Sweep = load_sweep(path)
        blocks = blocks_of(len(self.sweep), Config().trajectory.block_frames)
        self._matched = {block: match_ahead(self.sweep, curves, block) for block in blocks}

    def given(self, block: Block) -> MatchedBlock | None:
        """Return a block that is matched already."""
        return self._matched.get(block)

    def read(self, curves: DecorrelationCurves, straighten: bool = True) -> Tracked:
        """Track with some curves."""
        config = Config.model_validate({"curves": {"straighten": straighten}})
        return track(self.sweep, curves, config, matched=self.given)

    def off(self, tracked: Tracked) -> float:
        """Error of the length as a share."""
        assert self.sweep.truth is not None
        seen, true = (
            abs(float((poses[0].inv() * poses[-1]).apply(self.sweep.grid.centre_mm)[2]))
            for poses in (tracked.image, self.sweep.truth)
        )
        return seen / true - 1.0


def measure(
    seeds: Sequence[int] = (970_001, 970_002, 970_003, 970_004),
    folder: Path = DEFAULT,
    others: Sequence[Path] = (),
) -> list[Row]:
    """Rows of single sweeps: by the data sheet, straightened, and corrected by another sweep.

    Parameters
    ----------
    seeds : sequence of int
        Of tissue sweeps; each corrects curves for the next.
    others : sequence of path
        More sweeps to read, over phantoms.
    """
    own, borrowed = read_curves(OWN), borrowed_curves(22.0, 0.8, folder)
    scans = [Scan(crossing_pair(seed, 90.0, folder)[0], own) for seed in seeds]
    rows = [_plain("right curves", "phantom in steps, same probe", own, scans)]
    rows.append(_plain("borrowed curves", "lens focus 22 mm for 20, 0.8 dB/cm/MHz", borrowed, scans))
    rows += _sheets(scans)
    if others:
        plain = [Scan(path, own) for path in others]
        rows += [
            _plain(name, "over phantoms", c, plain) for name, c in (("right", own), ("borrowed", borrowed))
        ]
        rows += [Row(f"phantom: {row.case}", row.figures, row.target) for row in _sheets(plain)]
    rng = np.random.default_rng(1)
    for name, curves in (("borrowed", borrowed), ("data sheet, focus 23 mm", _sheet(23.0, scans[0].sweep))):
        rows += _corrected(name, curves, scans, rng)
    return rows


def _sheet(focus_mm: float, like: Sweep) -> DecorrelationCurves:
    sheet = ProbeSheet(elevation_aperture_mm=5.0, elevation_focus_mm=focus_mm, band_mhz=(5.0, 10.0))
    return data_sheet_curves(sheet, like)


def _plain(name: str, what: str, curves: DecorrelationCurves, scans: Sequence[Scan]) -> Row:
    found = [scan.read(curves) for scan in scans]
    return Row(f"{name}: {what}", _figures(scans, found), "within the claimed error")


def _sheets(scans: Sequence[Scan]) -> list[Row]:
    rows = []
    for focus in FOCI_MM:
        for straighten in (False, True):
            found = [scan.read(_sheet(focus, scan.sweep), straighten) for scan in scans]
            how = "straightened" if straighten else "as calculated"
            rows.append(Row(f"data sheet, focus {focus:g} mm, {how}", _figures(scans, found), "none"))
    return rows


def _corrected(
    name: str, curves: DecorrelationCurves, scans: Sequence[Scan], rng: np.random.Generator
) -> list[Row]:
    """Curves corrected by one sweep, its length known as by a crossing or by tracker, read on the next."""
    found = [scan.read(curves) for scan in scans]
    known = [
        -np.log1p(s.off(t)) + CROSSING_SIGMA * rng.standard_normal()
        for s, t in zip(scans, found, strict=True)
    ]
    scales = [[(k, CROSSING_SIGMA) for k in known]]
    scales.append([tracker_scale(s.sweep, t) for s, t in zip(scans, found, strict=True)])
    rows = []
    for what, lengths in zip(("a length known to 1 %", "its tracker"), scales, strict=True):
        nexts = [*scans[1:], scans[0]]
        read = []
        for tracked, (scale, sigma), after in zip(found, lengths, nexts, strict=True):
            read.append(after.read(corrected_curves(curves, [tracked], [scale], [sigma])))
        rows.append(
            Row(f"{name}, corrected by another tissue's sweep and {what}", _figures(nexts, read), "<= 2 %")
        )
    return rows


def _figures(scans: Sequence[Scan], found: Sequence[Tracked]) -> str:
    off = np.array([100 * scan.off(tracked) for scan, tracked in zip(scans, found, strict=True)])
    claimed = 100 * np.median([tracked.scale_sigma for tracked in found])
    each = ", ".join(f"{value:+.1f}" for value in off)
    return f"length {each} %; median of sizes {np.median(np.abs(off)):.1f} %, claimed {claimed:.1f} %"
