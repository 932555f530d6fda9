"""Files of one result: written in a hidden folder, then put in place so that old and new are never mixed.

A set has one file that readers open, `primary`, and others that go with it. The new files are written into a
hidden folder beside the old ones; giving that folder its second name is the moment from which the new result
counts. Then the old other files are removed, `primary` is replaced in one step, and the new other files come
to its side. Whenever the process is killed, what is there is of one result, and `primary` is there and whole;
the next run into the place finishes what had been decided and removes what had not.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from speckle3d.core.errors import FileError, Speckle3DError
from speckle3d.core.parts import cannot_write, clear_parts, locks
from speckle3d.io.hdf5 import atomic_path, make_folder, require_target


@dataclass(frozen=True)
class FileSet:
    """Files of one folder that are one result.

    Attributes
    ----------
    primary : str
        Name of the file by which readers find the result.
    others : tuple of str
        Names of what is written with it.
    derived : tuple of str
        Names, folders included, of what is made from the result later: removed when it is replaced.
    """

    primary: str
    others: tuple[str, ...]
    derived: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All that is written."""
        return (*self.others, self.primary)

    @contextmanager
    def replaced(self, folder: Path) -> Iterator[Path]:
        """Yield an empty folder to write the set into; if the block succeeds, it takes the old set's place.

        A folder that does not exist appears whole, with those above it; after a failure it still does not.

        Raises
        ------
        FileError
            If another run is at work on the same set, or the system refuses to write.
        """
        # A link to a folder, or the working directory as ".", stays what it is.
        given, folder = folder, folder.resolve()
        existed = folder.is_dir()
        if folder.exists() and not existed:
            raise FileError(f"{given}: expected a folder or a new name, got a file")
        for name in self.names if existed else ():
            require_target(folder / name)
        base, name = (folder, self.primary) if existed else (folder.parent, folder.name)
        above = [parent for parent in (base, *base.parents) if not parent.exists()]
        make_folder(base)
        part = _part(base, name)
        try:
            part.mkdir(exist_ok=True)
            with _locked(part):
                try:
                    for left in part.iterdir():  # of a killed run
                        shutil.rmtree(left) if left.is_dir() else left.unlink()
                    self._finish_killed(folder)
                    yield part
                    self._put_in_place(part, folder)
                except BaseException:
                    shutil.rmtree(part, ignore_errors=True)
                    raise
        except BlockingIOError as error:
            raise FileError(
                f"{given}: expected a place that no other run is at work in, got one that is taken"
            ) from error
        except Speckle3DError as error:
            if str(part) not in str(error):
                raise
            raise type(error)(str(error).replace(str(part), str(given))) from error
        except OSError as error:
            raise cannot_write(given, error) from error
        finally:
            for parent in above:
                with suppress(OSError):  # it holds something by now
                    parent.rmdir()

    def _decided(self, folder: Path) -> Path:
        """Where the new files of a set are from the moment that they count."""
        return folder / f".done-{self.primary}"

    def _put_in_place(self, part: Path, folder: Path) -> None:
        if not folder.exists():
            os.rename(part, folder)
            return
        try:
            os.rename(part, self._decided(folder))
            self._move(folder)
        except BaseException:  # Ctrl-C, too, comes too late
            self._move(folder)
            raise

    def _finish_killed(self, folder: Path) -> None:
        """Finish what a killed run had decided, and remove what it had not."""
        if not folder.is_dir():
            return
        # A run that is at it needs a moment more.
        with suppress(FileNotFoundError), _locked(self._decided(folder), wait=True):
            self._move(folder)
        before = _part(folder.parent, folder.name)  # of a run from before there was the folder
        with suppress(FileNotFoundError, BlockingIOError), _locked(before):
            shutil.rmtree(before)
        for name in self.names:
            clear_parts(folder / name)

    def _move(self, folder: Path) -> None:
        """Put decided files in place; can be broken off anywhere and done again."""
        decided = self._decided(folder)
        if not decided.is_dir():
            return
        if (decided / self.primary).exists():
            for name in (*self.others, *self.derived):
                (folder / name).resolve().unlink(missing_ok=True)
            _replace(decided / self.primary, folder / self.primary)
        for name in self.others:
            if (decided / name).exists():
                _replace(decided / name, folder / name)
        shutil.rmtree(decided)


def _replace(new: Path, target: Path) -> None:
    """Put a file in place in one step, through a link if there is one."""
    target = target.resolve()
    try:
        os.replace(new, target)
    except OSError as error:
        if error.errno != errno.EXDEV:  # the link leads to another disk
            raise
        with atomic_path(target) as part:
            shutil.copyfile(new, part)


@contextmanager
def _locked(folder: Path, wait: bool = False) -> Iterator[None]:
    """Lock a folder for the block, where there are locks; the system releases it however the process ends.

    Raises
    ------
    BlockingIOError
        If another process holds it.
    """
    fcntl = locks()
    file = None if fcntl is None else os.open(folder, os.O_RDONLY)
    try:
        if file is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except OSError as error:
                if isinstance(error, BlockingIOError):
                    raise  # else a file system without locks
        yield
    finally:
        if file is not None:
            os.close(file)


def _part(base: Path, name: str) -> Path:
    return base / f".part-{name}"
