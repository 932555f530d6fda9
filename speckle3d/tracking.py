"""Public `track`: checks arguments and finds curves, then runs `speckle3d.pipeline.track`."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import Sweep
from speckle3d.io.family.curves import read_curves
from speckle3d.matching.frames import ImageSink
from speckle3d.pipeline import PairSink
from speckle3d.pipeline import track as track_sweep
from speckle3d.tracked import Tracked


def track(
    sweep: Sweep,
    curves: DecorrelationCurves | None = None,
    config: Config | None = None,
    progress: Progress | None = None,
    sink: PairSink | None = None,
    images: ImageSink | None = None,
) -> Tracked:
    """Estimate the pose of every frame from the images, and from the orientation-consistent patches.

    The second set of poses, `Tracked.subset`, needs an orientation sensor calibrated to the image that has
    readings for all frames, or for frames nearby.

    Parameters
    ----------
    sweep : Sweep
        n frames, read one at a time.
    curves : DecorrelationCurves, optional
        Of the sweep's probe and settings; by default curves.h5 beside its recording, as the
        commands have it, and a warning says how far to trust them.
    config : Config, optional
    progress : callable, optional
        Called with frames done and frames in all; `speckle3d.progress_bar` makes one.
    sink : callable, optional
        Called with the frame pairs.
    images : callable, optional
        Called with every intensity image.

    Returns
    -------
    Tracked

    Raises
    ------
    MismatchError
        If the curves belong to another probe, frequency, sampling, patch size or depth, by what the files say
        or by what the images do; see `speckle3d.examine`.
    InsufficientDataError
        If too many frames have no speckle in common with others, if the images do not determine the length,
        or if they cannot be those of one probe that moves (`speckle3d.examine.images`).

    Examples
    --------
    >>> import speckle3d as s3
    >>> sweep = s3.load_sweep("data/phantom.h5").part(0, 32)
    >>> tracked = s3.track(sweep, s3.load_curves("data/curves.h5"))
    >>> len(tracked.image), tracked.direction_from, bool(tracked.flags.any())
    (32, 'tracker', False)
    """
    require_kind(sweep, Sweep, "load_sweep(path)")
    settings = config or Config()
    if curves is None:
        if sweep.path is None:
            raise InvalidInputError(
                f"{sweep.name}: expected curves of its probe (load_curves(path)), got none"
            )
        path = curves_beside(sweep.path)
        curves = read_curves(path)
        warnings.warn(trust_words(path, curves, settings.curves.same_probe), stacklevel=2)
    require_kind(curves, DecorrelationCurves, "load_curves(path)")
    with naming(sweep.name):
        return track_sweep(sweep, curves, settings, progress, sink, images)


def curves_beside(sweep_file: Path) -> Path:
    """Path of the default curves of a sweep: curves.h5 in its folder.

    Raises
    ------
    InvalidInputError
        If there are none.
    """
    path = sweep_file.parent / "curves.h5"
    if not path.is_file():
        raise InvalidInputError(
            f"expected decorrelation curves: --curves CURVES.h5 or {path}, got neither "
            "(speckle3d calibrate curves makes them from a phantom sweep or, with --probe, a data sheet)"
        )
    return path


def trust_words(path: Path, curves: DecorrelationCurves, same_probe: bool) -> str:
    """Message that names the default curves and how far to trust them."""
    percent = 196.0 * curves.mismatch(same_probe)
    return f"curves: {path}, by {curves.origin}; lengths by them are right to {percent:.0f} % (95 %)"


def require_kind(value: Any, kind: type, made_by: str) -> None:
    """Raise `InvalidInputError` unless an argument has a type.

    Parameters
    ----------
    value : object
        The argument.
    kind : type
    made_by : str
        What makes such an object, as ``load_sweep(path)``.

    Raises
    ------
    InvalidInputError
        If it is something else.
    """
    if not isinstance(value, kind):
        raise InvalidInputError(f"expected a {kind.__name__}, as {made_by} gives it, got {type(value)}")
