"""Files of one result: written in a hidden folder, then put in place so that old and new are never mixed.

A set has one file that readers open, `primary`, and others that go with it. The new files are written into a
hidden folder beside the old ones. Then the old other files are removed, `primary` is replaced in one step,
and the new other files come to its side: whenever the process is killed, what is there is of one result, and
`primary` is there and whole.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from speckle3d.core.errors import FileError, Speckle3DError
from speckle3d.core.files import cannot_write, locks
from speckle3d.io.hdf5 import make_folder, require_target


@dataclass(frozen=True)
class FileSet:
    """Files of one result in one folder.

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
        """Names of all files of the set."""
        return (*self.others, self.primary)

    @contextmanager
    def replaced(self, folder: Path) -> Iterator[Path]:
        """Yield an empty folder to write the set into; if the block succeeds, it takes the old set's place.

        A folder that does not exist appears whole; after a failure it still does not.

        Raises
        ------
        FileError
            If another run is at work on the same set, or the system refuses to write.
        """
        # A link to a folder, or the working directory as ".", stays what it is.
        place, folder = folder, folder.resolve()
        is_old = folder.is_dir()
        for name in self.names if is_old else ():
            require_target(folder / name)
        base, name = (folder, self.primary) if is_old else (folder.parent, folder.name)
        make_folder(base)
        part = base / f".part-{name}"
        try:
            with _lock(part):
                try:
                    yield part
                    if is_old:
                        self._put_in_place(part, folder)
                    else:
                        os.rename(part, folder)
                finally:
                    shutil.rmtree(part, ignore_errors=True)
        except Speckle3DError as error:
            raise type(error)(str(error).replace(str(part), str(place))) from error
        except OSError as error:
            raise cannot_write(place / self.primary, error) from error

    def _put_in_place(self, part: Path, folder: Path) -> None:
        for name in (*self.others, *self.derived):
            (folder / name).resolve().unlink(missing_ok=True)
        for name in (self.primary, *self.others):
            if (part / name).exists():
                shutil.move(part / name, (folder / name).resolve())  # through a link if there is one


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """Make an empty folder and lock it; the lock ends with the process, however that ends.

    Raises
    ------
    FileError
        If another process holds it.
    """
    folder.mkdir(exist_ok=True)
    file = os.open(folder, os.O_RDONLY) if (fcntl := locks()) is not None else None
    try:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                words = "expected a place that no other run is at work in, got one that is taken"
                raise FileError(f"{folder}: {words}") from error
            except OSError:
                pass  # a file system without locks
        for left in folder.iterdir():  # of a killed run
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        yield
    finally:
        if file is not None:
            os.close(file)
