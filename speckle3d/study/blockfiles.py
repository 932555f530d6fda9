"""Files of the matched blocks of a sweep, which its own job reads, and removes when the sweep is done.

One ``.npz`` for each block: ``key`` (of the sweep's job), ``frame`` (n,), ``strip`` (n, vector, sample), one
array for each field of `FrameFeatures`, and of e pairs, latest earlier frame first, ``first`` and ``second``
(e,), ``correlation`` (e, patch), ``median`` (e,), ``motion`` (e, 3), ``covariance`` (e, 3, 3) and
``has_covariance`` (e,). Numbers are kept to the last bit.
"""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.io.hdf5 import atomic_path, make_folder
from speckle3d.matching.blocks import Block, MatchedBlock, MatchedFrame
from speckle3d.matching.inplane import InPlaneMotion
from speckle3d.matching.quality import FrameFeatures
from speckle3d.matching.table import MatchedPair
from speckle3d.study.images import Strip

_BROKEN = (OSError, ValueError, KeyError, TypeError, IndexError, EOFError, zipfile.BadZipFile)
"""What NumPy raises on a damaged file, depending on where the damage is."""
_NO_COVARIANCE = np.full((3, 3), np.nan)

Arrays = Mapping[str, npt.NDArray[Any]]


@dataclass
class BlockFiles:
    """The blocks of one sweep.

    Attributes
    ----------
    folder : path
        Made when the first block is written.
    key : str
        Of the sweep's job; files with another are not taken.
    spent_s : float
        By the jobs of the blocks read so far.
    """

    folder: Path
    key: str
    spent_s: float = 0.0

    def path(self, block: Block) -> Path:
        """Where a block is, or would be."""
        return self.folder / f"{block.first:06d}-{block.stop:06d}.npz"

    def has(self, block: Block) -> bool:
        """Whether a block is there."""
        try:
            with np.load(self.path(block)) as file:
                return str(file["key"]) == self.key
        except _BROKEN:
            return False

    def write(self, block: Block, matched: MatchedBlock, strip: Strip, spent_s: float) -> None:
        """Write a block, whole or not at all."""
        make_folder(self.folder)
        held = {
            "key": np.array(self.key),
            "seconds": np.array(json.dumps(dict(matched.seconds))),
            "spent_s": np.array(spent_s),
            "strip": strip.kept(block.first, block.stop),
            **_frame_arrays(matched.frames),
            **_pair_arrays(matched.frames),
        }
        with atomic_path(self.path(block)) as part:
            np.savez(part, allow_pickle=False, **held)

    def read(self, block: Block, strip: Strip) -> MatchedBlock | None:
        """Read a block and its strips; None if it is not there, or is not whole."""
        try:
            with np.load(self.path(block)) as file:
                held = {name: file[name] for name in file.files}
            if str(held["key"]) != self.key:
                return None
            matched = MatchedBlock(_frames(held), json.loads(str(held["seconds"])))
            images, spent_s = held["strip"], float(held["spent_s"])
        except _BROKEN:
            return None
        strip.take(block.first, images)
        self.spent_s += spent_s
        return matched

    def clear(self) -> None:
        """Remove the blocks."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _frame_arrays(frames: Sequence[MatchedFrame]) -> dict[str, npt.NDArray[Any]]:
    columns = {f.name: np.array([getattr(each.features, f.name) for each in frames]) for f in _FEATURES}
    return {"frame": np.array([each.frame for each in frames])} | columns


def _pair_arrays(frames: Sequence[MatchedFrame]) -> dict[str, npt.NDArray[Any]]:
    pairs = [(first, each.frame, pair) for each in frames for first, pair in each.pairs.items()]
    motions = [pair.motion for _, _, pair in pairs]
    covariances = [_NO_COVARIANCE if m.covariance is None else m.covariance for m in motions]
    return {
        "first": np.array([first for first, _, _ in pairs]),
        "second": np.array([second for _, second, _ in pairs]),
        "correlation": np.array([pair.correlation for _, _, pair in pairs]),
        "median": np.array([pair.median for _, _, pair in pairs]),
        "motion": np.array([(m.x_mm, m.y_mm, m.roll_rad) for m in motions]),
        "covariance": np.array(covariances),
        "has_covariance": np.array([m.covariance is not None for m in motions]),
    }


def _frames(held: Arrays) -> list[MatchedFrame]:
    pairs: dict[int, dict[int, MatchedPair]] = {frame: {} for frame in held["frame"].tolist()}
    for row, (first, second) in enumerate(zip(held["first"].tolist(), held["second"].tolist(), strict=True)):
        pairs[second][first] = _pair(held, row)
    return [
        MatchedFrame(frame, _features(held, row), pairs[frame])
        for row, frame in enumerate(held["frame"].tolist())
    ]


def _pair(held: Arrays, row: int) -> MatchedPair:
    covariance = held["covariance"][row] if held["has_covariance"][row] else None
    x_mm, y_mm, roll_rad = held["motion"][row].tolist()
    motion = InPlaneMotion(x_mm, y_mm, roll_rad, covariance)
    return MatchedPair(held["correlation"][row], float(held["median"][row]), motion)


def _features(held: Arrays, row: int) -> FrameFeatures:
    values = {f.name: held[f.name][row] for f in _FEATURES}
    return FrameFeatures(**{name: v.item() if v.ndim == 0 else v for name, v in values.items()})


_FEATURES = fields(FrameFeatures)
