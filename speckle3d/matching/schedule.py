"""Schedule of the frame pairs measured as a sweep is read."""

from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import IntArray


class TrajectorySettings(BaseModel):
    """Settings of the choice of frame pairs and of the pose graph."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recent: int = Field(2, ge=1, description="Frames just before each frame that it is measured against.")
    key_frames: int = Field(4, ge=1, description="Key frames before each frame that it is measured against.")
    far_key_frames: int = Field(
        4, ge=0, description="Older key frames that every other frame is measured against, to see what stays."
    )
    key_correlation: float = Field(
        0.9,
        gt=0,
        lt=1,
        description="A frame becomes a key frame when its median correlation with the last is less.",
    )
    least_correlation: float = Field(
        0.2,
        gt=0,
        lt=1,
        description="Least median correlation that a pair must have, and that speckle at its distance would, "
        "to be used.",
    )
    clear_correlation: float = Field(
        0.4,
        gt=0,
        lt=1,
        description="Median correlation with the last frame below which a live sweep is told to go slower.",
    )
    huber: float = Field(2.0, gt=0, description="Standard deviations at which a pair begins to lose weight.")


class KnownSchedule:
    """Chosen pairs of a sweep, and each frame with the one before it, from which in-plane motion is followed.

    Parameters
    ----------
    pairs : ndarray, shape (m, 2)
        First and second frame of each.
    """

    least_correlation = 0.0

    def __init__(self, pairs: IntArray) -> None:
        self._pairs = pairs

    def references(self, frame: int) -> list[int]:
        """Return the frame before and the first frames of the pairs."""
        firsts = set(self._pairs[self._pairs[:, 1] == frame, 0].tolist()) - {frame - 1}
        return [frame - 1, *sorted(firsts)] if frame else []

    def settle(self, frame: int, correlations: dict[int, float]) -> None:
        """Do nothing: the pairs are known."""

    def needed(self, frame: int) -> set[int]:
        """Return this frame and the first frames of later pairs."""
        return {frame, *self._pairs[self._pairs[:, 1] > frame, 0].tolist()}


class PairSchedule:
    """Keeps the frames that the next one is measured against: a few recent ones and a few key frames.

    Frames that resemble none of theirs, as with the probe lifted, are never key frames, and the last ones
    before them are kept until one resembles them again.
    """

    def __init__(self, settings: TrajectorySettings) -> None:
        self.settings = settings
        self.least_correlation = self.settings.least_correlation
        self._keys: list[int] = []
        self._sound: list[int] = []

    def references(self, frame: int) -> list[int]:
        """Earlier frames to measure `frame` against: the last sound one, then latest first."""
        far = () if frame % 2 else self._keys[: -self.settings.key_frames]
        latest_first = sorted(self.needed(frame - 1).difference(far), reverse=True)
        return sorted(latest_first, key=lambda earlier: earlier not in self._sound[-1:])

    def settle(self, frame: int, correlations: dict[int, float]) -> None:
        """Take note of the median correlations of `frame` with its references."""
        if correlations and max(correlations.values()) < self.settings.least_correlation:
            return
        self._sound = [*self._sound, frame][-self.settings.recent :]
        last = self._keys[-1] if self._keys else None
        if last is None or correlations.get(last, 0.0) < self.settings.key_correlation:
            self._keys = [*self._keys, frame][-(self.settings.key_frames + self.settings.far_key_frames) :]

    def needed(self, frame: int) -> set[int]:
        """Frames up to `frame` that later ones may be measured against."""
        recent = range(max(0, frame - self.settings.recent + 1), frame + 1)
        return {*recent, *self._keys, *self._sound}
