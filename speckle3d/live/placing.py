"""The latest frame placed at once, with what is known of the sweep so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.live.window import FramePlanes, Known, Window
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.planes import PairPlanes
from speckle3d.motion.signs import ADAPTED_ERROR, PLAIN_ERROR, SignedPairs

OPEN = 24
"""Latest frames whose signs are still open and whose poses still move: a second at 25 frames a second."""


@dataclass(frozen=True)
class Placed:
    """Poses of the latest frames, from `first` on, and the planes of the last of them."""

    first: int
    poses: RigidTransform
    planes: FramePlanes


def place_latest(
    tables: Sequence[CorrelationTable],
    planes: Sequence[FramePlanes],
    bad: BoolArray,
    poses: RigidTransform,
    known: Known,
) -> Placed:
    """Place the latest frame against the earlier ones it was matched with, and those just before it again.

    Distances are read twice: first wherever the frame may be, then about where that puts it, with the pairs
    that are near enough to tell a distance.

    Parameters
    ----------
    tables : sequence of CorrelationTable, length n
        Pairs of each frame.
    planes : sequence of FramePlanes
        Of the latest frames, `OPEN` at least if there are so many; the last's are not used.
    bad : ndarray of bool, shape (n,)
        Frames that are not to be trusted.
    poses : RigidTransform, length n
        Of all frames; that of the latest is not used.
    """
    latest = len(tables) - 1
    first = max(1, latest + 1 - OPEN)
    window = Window.of(tables, first, poses, bad, known.reader)
    reader = known.reader.of_frames(window.frames.size)
    coherence = window.coherence_here(known.coherence)
    error = PLAIN_ERROR if coherence is None else ADAPTED_ERROR
    own = len(window.table) - len(tables[latest])
    table, sound = window.table.part(own), window.sound[own:]

    def signed(latest_planes: FramePlanes) -> tuple[SignedPairs, FloatArray]:
        every = _pairs_of(window, [*planes[first - 1 - latest : -1], latest_planes], tables[first:])
        return reader.signed(window.table, every, window.sound, window.path[: window.fixed], error)

    path = window.path
    path[-1] = 2 * path[-2] - path[-3] if len(path) > 2 else path[-2]
    rough = reader.roughly(table, coherence)
    path[-1] = signed(_planes_of(rough, window))[1][-1]
    found = _planes_of(reader.unsigned(table, path, sound, coherence), window)
    pairs, _ = signed(found)
    return Placed(first, window.placed(pairs, known.slopes, reader)[window.fixed :], found)


def _planes_of(pairs: SignedPairs, window: Window) -> FramePlanes:
    return FramePlanes(pairs.row, window.frames[pairs.first], pairs.planes)


def _pairs_of(
    window: Window, planes: Sequence[FramePlanes], tables: Sequence[CorrelationTable]
) -> SignedPairs:
    """Pairs of several frames in a row, in a window's numbers; `tables` are theirs."""
    begin = np.concatenate([[0], np.cumsum([len(each) for each in tables])])
    row = np.concatenate([each.row + start for each, start in zip(planes, begin[:-1], strict=True)])
    every = PairPlanes.concatenate([each.planes for each in planes])
    return SignedPairs(row, window.table.first[row], window.table.second[row], None, every, np.ones(row.size))
