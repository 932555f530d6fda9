"""What about a recording cannot be believed, and why."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Doubt:
    """A contradiction between streams of one recording, or within one.

    Attributes
    ----------
    about : str
        What is doubted: "tracker", "orientation sensor", "curves" or "images".
    suspect : str
        The likely cause in a word or two: "units", "handedness", "clock", ...
    evidence : str
        What was expected and what was seen, one line with figures.
    refuted : bool
        True if no honest noise explains it: what rests on it is refused. False: used, and flagged.
    """

    about: str
    suspect: str
    evidence: str
    refuted: bool

    def __str__(self) -> str:
        return f"{self.about}: {self.evidence} (suspect: {self.suspect})"

    @property
    def consequence(self) -> str:
        """The doubt as a line, which says so where what is doubted is not used."""
        return f"{self}; refused" if self.refuted else str(self)
