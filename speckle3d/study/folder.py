"""A study's folder: names of its sweeps, the lock that lets one run at a time work in it, files of blocks."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shutil
import socket
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import FileError
from speckle3d.core.printable import printable
from speckle3d.io.hdf5 import atomic_path, make_folder, one_line
from speckle3d.matching.blocks import Block, MatchedBlock, MatchedFrame
from speckle3d.matching.inplane import InPlaneMotion
from speckle3d.matching.quality import FrameFeatures
from speckle3d.matching.table import MatchedPair
from speckle3d.study.images import Strip

LOCK = ".lock"

_FEATURES = tuple(each.name for each in fields(FrameFeatures))
_BROKEN = (OSError, ValueError, KeyError, TypeError, IndexError, EOFError, zipfile.BadZipFile)
"""What NumPy raises on a damaged file, depending on where the damage is."""

_HELD: ContextVar[tuple[Path, ...]] = ContextVar("held", default=())
"""Folders that the caller holds already: a study that simulates its sweeps holds its folder for both."""


def named(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Name each file once, by its stem, with as many parent folders as tell it from others of that stem.

    Names depend on the files alone, not on their order: a study given again in another order is the same.
    """
    given = {path.resolve(): path.absolute() for path in reversed(paths)}
    files = [given[target] for target in dict.fromkeys(path.resolve() for path in paths)]
    stems = Counter(path.with_suffix("") for path in files)
    words = [
        # Beside a file that differs in its suffix alone, the suffix belongs to the name.
        [*path.parts[1:-1], path.stem if stems[path.with_suffix("")] == 1 else path.name.replace(".", "-")]
        for path in files
    ]
    words = [[_folder_word(word) for word in each] for each in words]
    depth = [1] * len(files)
    names = _joined(words, depth)
    while alike := [i for i, n in enumerate(names) if names.count(n) > 1 and depth[i] < len(words[i])]:
        for i in alike:
            depth[i] += 1
        names = _joined(words, depth)
    # Folders joined may still be alike: a-b/c and a/b-c.
    marks = [hashlib.sha256(os.fsencode(path)).hexdigest()[:6] for path in files]
    unique = [n if names.count(n) == 1 else f"{n}-{mark}" for n, mark in zip(names, marks, strict=True)]
    return list(zip(unique, files, strict=True))


@contextmanager
def only_run(directory: Path) -> Iterator[None]:
    """Hold a study's folder, which is made if need be, during the block.

    The operating system releases the lock when the process ends, however it ends; the lock file's text only
    tells the reader of an error who holds it. A folder that was made, and in which nothing came to be, is
    removed again.

    Raises
    ------
    FileError
        If another run holds it, or the folder cannot be written.
    """
    folder = directory.resolve()
    if folder in _HELD.get():
        yield
        return
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    make_folder(folder)
    try:
        file = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise FileError(f"{directory}: cannot be written: {one_line(error)}") from error
    token = None
    try:
        _take(file, directory)
        token = _HELD.set((*_HELD.get(), folder))
        yield
    finally:
        if token is not None:
            _HELD.reset(token)
            if made and os.listdir(folder) == [LOCK]:
                (folder / LOCK).unlink()
                for each in made:
                    each.rmdir()
        os.close(file)


def _folder_word(word: str) -> str:
    """Escape what a terminal would obey in the name of a folder, with % in place of the backslash."""
    shown = printable(word)
    return shown if shown == word else shown.replace("\\", "%")


def _joined(words: Sequence[Sequence[str]], depth: Sequence[int]) -> list[str]:
    return ["-".join(each[-d:]) for each, d in zip(words, depth, strict=True)]


def _take(file: int, directory: Path) -> None:
    try:
        fcntl = importlib.import_module("fcntl")
    except ImportError:  # Windows has none
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        who = os.pread(file, 200, 0).decode("utf-8", "replace").strip() or "another process"
        raise FileError(
            f"{directory}: expected a folder that no other run is at work in, got one held by {who}"
        ) from None
    except OSError:
        return  # a file system without locks
    os.truncate(file, 0)
    os.pwrite(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)


@dataclass
class BlockFiles:
    """Matched blocks of one sweep, which its own job reads, and removes when the sweep is done.

    One ``.npz`` for each block: ``key``, ``frame`` (n,), ``strip`` (n, vector, sample), one array for each
    field of `FrameFeatures`, and of e pairs, latest earlier frame first, ``first`` and ``second`` (e,),
    ``correlation`` (e, patch), ``median`` (e,), ``motion`` (e, 3), ``covariance`` (e, 3, 3) and
    ``has_covariance`` (e,). Numbers are kept to the last bit.

    Attributes
    ----------
    folder : path
        Made when the first block is written.
    key : str
        Of the sweep's job; files with another are not taken.
    spent_s : float
        By the jobs of the blocks read so far.
    """

    folder: Path
    key: str
    spent_s: float = 0.0

    def path(self, block: Block) -> Path:
        """Where a block is, or would be."""
        return self.folder / f"{block.first:06d}-{block.stop:06d}.npz"

    def has(self, block: Block) -> bool:
        """Whether a block is there."""
        try:
            with np.load(self.path(block)) as file:
                return str(file["key"]) == self.key
        except _BROKEN:
            return False

    def write(self, block: Block, matched: MatchedBlock, strip: Strip, spent_s: float) -> None:
        """Write a block, whole or not at all."""
        make_folder(self.folder)
        frames = matched.frames
        pairs = [(first, each.frame, pair) for each in frames for first, pair in each.pairs.items()]
        motions = [pair.motion for _, _, pair in pairs]
        unknown = np.full((3, 3), np.nan)
        held: dict[str, npt.ArrayLike] = {
            "key": self.key,
            "seconds": json.dumps(dict(matched.seconds)),
            "spent_s": spent_s,
            "strip": strip.kept(block.first, block.stop),
            "frame": [each.frame for each in frames],
            "first": [first for first, _, _ in pairs],
            "second": [second for _, second, _ in pairs],
            "correlation": [pair.correlation for _, _, pair in pairs],
            "median": [pair.median for _, _, pair in pairs],
            "motion": [(m.x_mm, m.y_mm, m.roll_rad) for m in motions],
            "covariance": [unknown if m.covariance is None else m.covariance for m in motions],
            "has_covariance": [m.covariance is not None for m in motions],
        }
        held |= {name: [getattr(each.features, name) for each in frames] for name in _FEATURES}
        with atomic_path(self.path(block)) as part:
            np.savez(part, allow_pickle=False, **held)

    def read(self, block: Block, strip: Strip) -> MatchedBlock | None:
        """Read a block and its strips; None if it is not there, or is not whole."""
        try:
            with np.load(self.path(block)) as file:
                held = {name: file[name] for name in file.files}
            if str(held["key"]) != self.key:
                return None
            matched = MatchedBlock(_matched_frames(held), json.loads(str(held["seconds"])))
            images, spent_s = held["strip"], float(held["spent_s"])
        except _BROKEN:
            return None
        strip.take(block.first, images)
        self.spent_s += spent_s
        return matched

    def clear(self) -> None:
        """Remove the blocks."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _matched_frames(held: Mapping[str, npt.NDArray[Any]]) -> list[MatchedFrame]:
    numbers = held["frame"].tolist()
    pairs: dict[int, dict[int, MatchedPair]] = {frame: {} for frame in numbers}
    for row, (first, second) in enumerate(zip(held["first"].tolist(), held["second"].tolist(), strict=True)):
        covariance = held["covariance"][row] if held["has_covariance"][row] else None
        x_mm, y_mm, roll_rad = held["motion"][row].tolist()
        motion = InPlaneMotion(x_mm, y_mm, roll_rad, covariance)
        pairs[second][first] = MatchedPair(held["correlation"][row], float(held["median"][row]), motion)
    frames = []
    for row, frame in enumerate(numbers):
        values = {name: held[name][row] for name in _FEATURES}
        features = FrameFeatures(**{name: v.item() if v.ndim == 0 else v for name, v in values.items()})
        frames.append(MatchedFrame(frame, features, pairs[frame]))
    return frames
