"""What about a recording cannot be believed, and why."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import IntArray
from speckle3d.core.errors import Speckle3DError


@dataclass(frozen=True)
class Doubt:
    """A contradiction between streams of one recording, or within one.

    Attributes
    ----------
    about : str
        What is doubted: "tracker", "orientation sensor", "curves" or "images"; "images and
        tracker" where these disagree.
    suspect : str
        The likely cause in a word or two: "units", "handedness", ...; empty where either may be wrong.
    evidence : str
        What was expected and what was seen, one line with figures.
    refuted : bool
        True if no honest noise explains it: what rests on it is refused. False: used, and flagged.
    frames : tuple of (int, int)
        First and last frames of the stretches where it was found; empty for the recording as a whole.
    """

    about: str
    suspect: str
    evidence: str
    refuted: bool
    frames: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        # As read from JSON these are lists.
        object.__setattr__(self, "frames", tuple((int(first), int(last)) for first, last in self.frames))

    def __str__(self) -> str:
        cause = f" (suspect: {self.suspect})" if self.suspect else ""
        return f"{self.about}: {self.evidence}{cause}"

    @property
    def consequence(self) -> str:
        """The doubt as a line, which says so where what is doubted is not used."""
        return f"{self}; refused" if self.refuted else str(self)


def runs_of(frames: IntArray) -> tuple[tuple[int, int], ...]:
    """First and last of every run of consecutive frames.

    Parameters
    ----------
    frames : ndarray of int
        In any order; any number of times each.

    Examples
    --------
    >>> runs_of(np.array([7, 3, 4, 4]))
    ((3, 4), (7, 7))
    """
    ordered = np.unique(frames)
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1)
    return tuple((int(run[0]), int(run[-1])) for run in runs if run.size)


def unrefuted(doubts: Iterable[Doubt | None], where: str, error: type[Speckle3DError]) -> tuple[Doubt, ...]:
    """Return doubts that leave what is doubted usable; raise `error` with the first that does not."""
    found = tuple(doubt for doubt in doubts if doubt is not None)
    for doubt in found:
        if doubt.refuted:
            raise error(f"{where}: {doubt}")
    return found
