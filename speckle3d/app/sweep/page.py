"""The sweep player."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from panel.viewable import Viewable

from speckle3d.app.folder import Folder
from speckle3d.app.sweep.findings import FrameFindings
from speckle3d.app.sweep.pairs import SweepPairs
from speckle3d.app.sweep.player import Player
from speckle3d.app.sweep.screen import ScreenImages
from speckle3d.app.sweep.streams import streams_of
from speckle3d.config import Config, stored_config
from speckle3d.core.doubts import Doubt
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import Sweep
from speckle3d.examine.sensors import believed


class SweepPage:
    """Frames of a sweep with a slider and the keyboard, their patches, flags, doubts and sensors.

    Parameters
    ----------
    sweep : Sweep
    folder : Folder
        Of its file.
    reconstruction : Reconstruction, optional
        Made from the sweep, with its frame pairs.
    doubts : sequence of Doubt, optional
        What the checks found as it was made; None if that is not known.
    """

    title = "Sweep"

    def __init__(
        self,
        sweep: Sweep,
        folder: Folder,
        reconstruction: Reconstruction | None = None,
        doubts: Sequence[Doubt] | None = None,
    ) -> None:
        self._sweep, self._folder = sweep, folder
        self._reconstruction, self._doubts = reconstruction, doubts

    def view(self) -> Viewable:
        """Frames with a slider."""
        made, config = self._reconstruction, self._config
        return Player(
            self._sweep,
            self._images,
            SweepPairs(self._sweep, config, None if made is None else made.pairs, self._by_orientation),
            FrameFindings(self._sweep, config, made, self._doubts),
            streams_of(self._sweep),
        ).view()

    @cached_property
    def _config(self) -> Config:
        made = self._reconstruction
        return stored_config(made.config_toml) if made is not None and made.config_toml else Config()

    @property
    def _by_orientation(self) -> bool:
        """Whether the reconstruction had a sensed orientation to choose patches by."""
        if self._reconstruction is None:
            return False
        sensor = believed(self._sweep, self._doubts or ()).orientation_source
        # A calibration that was given then is not in the sweep.
        mounted = bool(self._reconstruction.provenance.calibrations)
        if sensor is None or not (mounted or sensor.sensor_from_image is not None):
            return False
        return self._config.sensors.consistent_subset and bool(sensor.covers(self._sweep.frame_time_s).all())

    @cached_property
    def _images(self) -> ScreenImages:
        return ScreenImages(self._sweep, self._config.intensity)
