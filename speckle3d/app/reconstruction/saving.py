"""Saving what is seen, and the command that makes it again."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path

import panel as pn
from panel.viewable import Viewable

from speckle3d.app.folder import Folder
from speckle3d.app.reconstruction.commands import reslice_command
from speckle3d.app.reconstruction.cuts.cuts_view import TITLES
from speckle3d.app.reconstruction.cuts.material import Material
from speckle3d.app.reconstruction.cuts.shown import Name, Shown
from speckle3d.core.errors import Speckle3DError
from speckle3d.study.figures import RANGE_DB
from speckle3d.study.reslices.cuts import cut_posed
from speckle3d.study.reslices.reslice_figures import save_outlines, save_reslices

_OUTLINES = "frames in space"
_CODE = (
    "font-family:ui-monospace,'DejaVu Sans Mono',monospace;font-size:11px;white-space:pre-wrap;"
    "overflow-wrap:anywhere;user-select:all;background:#f3f5f7;padding:6px;border:1px solid #d5dae0"
)


class Saving:
    """A choice of what is seen, its command, and a button that saves its picture.

    Parameters
    ----------
    material : Material
    folder : Folder
    sweep_file : path, optional
    width_px : int
    """

    def __init__(self, material: Material, folder: Folder, sweep_file: Path | None, width_px: int) -> None:
        self._material, self._folder, self._sweep_file = material, folder, sweep_file
        self._shown = Shown(material.modes[0])
        choices: dict[str, Name | None] = {words: name for name, words in TITLES.items()} | {_OUTLINES: None}
        self.what = pn.widgets.Select(name="picture of", options=choices, value="free", width=width_px)
        self.name = pn.widgets.TextInput(name="file", value="free.png", width=width_px)
        self.button = pn.widgets.Button(name="save the picture", button_type="primary", width=width_px)
        self.command = pn.pane.HTML("", width=width_px)
        self.said = pn.pane.HTML("", width=width_px)
        self.what.param.watch(self._chosen, "value")
        self.name.param.watch(lambda _: self._tell_command(), "value_input")
        self.button.on_click(lambda _: self._save())

    def layout(self) -> Viewable:
        """The widgets below each other."""
        words = pn.pane.HTML(f"The command that makes it again, in {escape(str(self._folder.path))}:")
        return pn.Column(self.what, self.name, self.button, self.said, words, self.command, margin=0)

    def show(self, shown: Shown) -> None:
        """Take what is shown now."""
        self._shown = shown
        self._tell_command()

    def _chosen(self, event: object) -> None:
        self.name.value = f"{self.what.value or 'frames'}.png"
        self._tell_command()

    def _tell_command(self) -> None:
        name: Name | None = self.what.value
        axes = self._material.axes(self._shown.mode)
        place = None if name is None else self._shown.place(name, axes, self._material)
        source = Path(self._folder.opened.name)
        out = _as_png(self.name.value_input or self.name.value or "")
        self.command.object = code(reslice_command(source, out, self._shown, place, self._sweep_file))

    def _save(self) -> None:
        try:
            path = self._folder.save(_as_png(self.name.value or ""), self._writer())
            self.said.object = f"saved {escape(path.name)}"
        except (Speckle3DError, OSError) as error:
            self.said.object = f"<span style='color:#a03000'>{escape(str(error))}</span>"

    def _writer(self) -> Callable[[Path], object]:
        material, shown, name = self._material, self._shown, self.what.value
        opened = material.opened(*shown.modes)
        if name is None:
            return lambda path: save_outlines(opened, path)
        place = shown.place(name, material.axes(shown.mode), material)
        picture = cut_posed(opened, place, RANGE_DB, made=material.images())
        return lambda path: save_reslices(picture, path)


def _as_png(name: str) -> str:
    return name if not name.strip() or name.endswith(".png") else f"{name}.png"


def code(text: str) -> str:
    """Text of a command that one click selects."""
    return f'<div style="{_CODE}">{escape(text)}</div>'
