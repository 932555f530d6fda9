"""The browser app: sweeps, reconstructions, phantoms and sensors to look at, and to tune what is detected."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from panel.viewable import Viewable

    from speckle3d.core.files import PathLike


def view(path: PathLike, reconstruction: PathLike | None = None, sweep: PathLike | None = None) -> Viewable:
    """Show in a notebook what ``speckle3d view`` shows in the browser.

    Parameters
    ----------
    path : path
        A recording, a reconstruction or its results folder, or a log of the orientation sensor.
    reconstruction : path, optional
        Of the recording, to be seen with it.
    sweep : path, optional
        The sweep of a reconstruction, if it moved.

    Returns
    -------
    Viewable
        Shown if it is the last line of a cell; needs Panel (the extra ``app``).

    Raises
    ------
    FileError
        If it cannot be read.
    InvalidInputError
        If it is none of these.
    MismatchError
        If reconstruction and recording do not belong together.

    Examples
    --------
    >>> from speckle3d.app import view
    >>> shown = view("data/phantom.h5")
    """
    from speckle3d.app.look import shell
    from speckle3d.app.opened import pages_of

    result_file, sweep_file = (Path(file) if file else None for file in (reconstruction, sweep))
    return shell(pages_of(Path(path), result_file, sweep_file))
