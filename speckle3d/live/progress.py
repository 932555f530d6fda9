"""Progress of a live session, and the devices that it hears from."""

from dataclasses import dataclass

from speckle3d.io.igtl.messages import ImageReceived, Received


@dataclass
class Progress:
    """Counts, length and remarks of a live session, for a line on the terminal.

    Attributes
    ----------
    frames, poses, left : int
        Frames in the file, frames with a pose, and frames left for later.
    delay_s : float
        From a frame's message to its pose's, the last one.
    length_mm : float
        Between the first and the last frame's centres, along the first's elevational axis.
    length_sigma : float
        Relative standard deviation of it; NaN before it is known.
    words : str
    volumes : int
        Sent.
    refusals : int
        Messages that could not be used; `last_refusal` says why.
    restarts : int
        How often the sender's clock began anew.
    missing : str
        Which device that was asked for has sent nothing, and which others have.
    failure : str
        Why frames are no longer placed, or volumes no longer sent; they are recorded all the same.
    """

    frames: int = 0
    poses: int = 0
    left: int = 0
    delay_s: float = 0.0
    length_mm: float = 0.0
    length_sigma: float = float("nan")
    words: str = ""
    volumes: int = 0
    refusals: int = 0
    restarts: int = 0
    last_refusal: str = ""
    missing: str = ""
    failure: str = ""

    @property
    def length(self) -> str:
        """The length so far with its error, as far as it is known."""
        half_mm = 1.96 * self.length_sigma * abs(self.length_mm)
        return f"{self.length_mm:+.1f} mm" + (f" ±{half_mm:.1f} (95 %)" if half_mm == half_mm else "")

    @property
    def line(self) -> str:
        """Progress as one line of text."""
        parts = [
            f"{self.frames} frames",
            self.length.replace("±", "+-"),
            f"pose after {1e3 * self.delay_s:.0f} ms",
        ]
        parts += [f"{self.left} left for later"] if self.left else []
        parts += [f"the sender's clock began anew {self.restarts} times"] if self.restarts else []
        parts += [f"{self.refusals} refused ({self.last_refusal})"] if self.refusals else []
        return " | ".join(filter(None, (", ".join(parts), self.words, self.missing, self.failure)))


class Devices:
    """Devices requested, and those heard from.

    Parameters
    ----------
    image, transform, orientation : str or None
        Those that were asked for, by name.
    """

    def __init__(self, image: str | None, transform: str | None, orientation: str | None) -> None:
        devices = (("IMAGE", image), ("TRANSFORM", transform), ("TRANSFORM", orientation))
        self._wanted = [(kind, name) for kind, name in devices if name is not None]
        self._heard: set[tuple[str, str]] = set()

    def hear(self, message: Received) -> None:
        """Note who sent a message."""
        kind = "IMAGE" if isinstance(message, ImageReceived) else "TRANSFORM"
        self._heard.add((kind, message.device))

    @property
    def missing(self) -> str:
        """Requested devices that have sent nothing, beside others that have; empty if none."""
        sentences = []
        for kind, name in self._wanted:
            if (kind, name) not in self._heard:
                devices = ", ".join(sorted(device for heard, device in self._heard if heard == kind))
                sentences.append(f"no {kind} {name}" + (f", but {devices}" if devices else " yet"))
        return "; ".join(sentences)
