"""Findings about a recording: what is contradicted, by what evidence."""

from __future__ import annotations

from dataclasses import dataclass


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
        """The finding as one line of text, with its consequence."""
        return f"{self}; refused" if self.refuted else str(self)
