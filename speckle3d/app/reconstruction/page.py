"""The reconstruction viewer: trajectories in space, cuts at the poses of one mode or two, measurements."""

from __future__ import annotations

from pathlib import Path

from panel.viewable import Viewable

from speckle3d.app.folder import Folder
from speckle3d.app.reconstruction.cuts.material import Material
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import Sweep


class ReconstructionPage:
    """A reconstruction with the sweep it was made from.

    Parameters
    ----------
    reconstruction : Reconstruction
        Its pairs are not needed.
    sweep : Sweep
        Of the frames that were reconstructed; see `speckle3d.study.images.open_reconstruction`.
    folder : Folder
        Of the reconstruction's file.
    sweep_file : path, optional
        The sweep, if it is not where the reconstruction says: commands that are shown then name it.
    """

    title = "Reconstruction"
    extensions = ("plotly",)

    def __init__(
        self, reconstruction: Reconstruction, sweep: Sweep, folder: Folder, sweep_file: Path | None = None
    ) -> None:
        self._material = Material(reconstruction, sweep)
        self._folder, self._sweep_file = folder, _named(sweep_file, reconstruction, folder)

    def view(self) -> Viewable:
        """Trajectories, cuts and what is measured in them."""
        from speckle3d.app.reconstruction.viewer import Viewer

        return Viewer(self._material, self._folder, self._sweep_file).view()


def _named(sweep_file: Path | None, reconstruction: Reconstruction, folder: Folder) -> Path | None:
    """The sweep's path, if a command in the folder would not find it by what the reconstruction says."""
    stored = Path(reconstruction.provenance.input_path)
    if sweep_file is None and (folder.path / stored).exists():
        return None
    found = sweep_file or stored
    return found.resolve() if found.exists() else None
