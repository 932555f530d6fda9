"""Wires in a recording, found without help: crossings, and N-shapes whose wires are told apart."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calibration.clock.offset import covered
from calibration.detection.dots import dots_in_frames, single_dots
from calibration.detection.labelling import label_dots
from calibration.job import Progress, Recording, Seen
from calibration.nwires import label_and_start
from speckle3d.core.streams import TimedPoses
from speckle3d.core.wires import WirePhantom


def seen_crossings(
    recording: Recording, region_px: npt.ArrayLike | None = None, progress: Progress | None = None
) -> Seen:
    """The one bright dot of each image that a crossing of wires, or a bead, makes."""
    dots = dots_in_frames(recording.images, recording.pixel_mm, None, region_px, progress)
    single = single_dots(dots)
    return Seen(single.frame, single.pixels, None, single.dropped)


def seen_nwires(
    recording: Recording,
    phantom: WirePhantom,
    region_px: npt.ArrayLike | None = None,
    progress: Progress | None = None,
) -> Seen:
    """The dots of an N-wire phantom and the wires they show.

    Where every frame has a sensor reading, wires are told apart a second time by the calibration that follows
    from the frames that show all of them.
    """
    dots = dots_in_frames(recording.images, recording.pixel_mm, None, region_px, progress)
    times = recording.frame_time_s
    everywhere = covered(recording.readings, times, recording.time_offset_s).all()
    if isinstance(recording.readings, TimedPoses) and everywhere:
        poses = recording.readings.at(times - recording.time_offset_s)
        labelled = label_and_start(dots, phantom, poses, recording.pixel_mm)[0]
    else:
        labelled = label_dots(dots, phantom, recording.pixel_mm)
    return Seen(labelled.frame, np.asarray(labelled.pixels), labelled.wire, labelled.dropped)
