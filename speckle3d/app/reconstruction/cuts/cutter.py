"""Cuts for one viewer, made in the background: at once from voxels, and from the frames when at rest."""

from __future__ import annotations

from collections.abc import Callable

from speckle3d.app.reconstruction.cuts.material import Material, NotWanted
from speckle3d.app.reconstruction.cuts.newest import Newest
from speckle3d.app.reconstruction.cuts.shown import NAMES, Name, Shown, cut_of_voxels
from speckle3d.core.errors import Speckle3DError
from speckle3d.study.figures import RANGE_DB
from speckle3d.study.reslices.cuts import CutPicture, cut_posed

REST_S = 0.3
"""Time without a change after which cuts are made from the frames."""

Told = Callable[[Name, tuple[object, ...], "CutPicture | str", bool], None]


class Cutter:
    """Makes the cuts that are asked for and have changed.

    Parameters
    ----------
    material : Material
    told : callable
        Called from other threads with the cut's name, its key, the cut or why there is none, and whether it
        was made from the frames.
    """

    def __init__(self, material: Material, told: Told) -> None:
        self._material, self._told = material, told
        self._latest: dict[Name, tuple[tuple[object, ...], bool]] = {}
        self._quickly = Newest(self._cut_quickly)
        self._finely = Newest(self._cut_finely, REST_S)

    def ask(self, shown: Shown) -> None:
        """Have the cuts of `shown` made that are not yet."""
        self._quickly.ask(shown)

    def forget(self) -> None:
        """Make all cuts again, as they are shown in another way."""
        self._latest.clear()

    def _cut_quickly(self, shown: Shown) -> None:
        for name in NAMES:
            if self._quickly.has_newer:
                return
            if self._latest.get(name, (None, False))[0] != shown.key(name):
                self._told_of(name, shown, self._from_voxels(name, shown), False)
        self._finely.ask(shown)

    def _cut_finely(self, shown: Shown) -> None:
        def look() -> None:
            if self._finely.has_newer or self._quickly.has_newer:
                raise NotWanted

        for name in NAMES:
            if self._latest.get(name) == (shown.key(name), True):
                continue
            try:
                look()
                self._told_of(name, shown, self._from_frames(name, shown, look), True)
            except NotWanted:
                return

    def _told_of(self, name: Name, shown: Shown, found: CutPicture | str | None, is_fine: bool) -> None:
        if found is not None:
            self._told(name, shown.key(name), found, is_fine)
            self._latest[name] = shown.key(name), is_fine

    def _from_voxels(self, name: Name, shown: Shown) -> CutPicture | str | None:
        material = self._material
        try:
            held = {mode: material.voxels(mode) for mode in shown.modes}
            made = {mode: each for mode, each in held.items() if each is not None}
            if len(made) < len(held):
                return None
            place = shown.place(name, material.axes(shown.mode), material)
            return cut_of_voxels(material.opened(*shown.modes), place, material, made)
        except Speckle3DError as error:
            return str(error)

    def _from_frames(self, name: Name, shown: Shown, look: Callable[[], None]) -> CutPicture | str:
        material = self._material
        try:
            place = shown.place(name, material.axes(shown.mode), material)
            return cut_posed(material.opened(*shown.modes), place, RANGE_DB, made=material.images(look))
        except Speckle3DError as error:
            return str(error)
