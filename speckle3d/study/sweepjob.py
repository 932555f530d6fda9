"""Jobs of a study: one for each sweep, in a folder of its own, and one for each block of a long sweep.

A job is sent to a worker and never raises: whatever goes wrong becomes the reason in its outcome. The job of
a long sweep takes what the jobs of its blocks left on disk (`speckle3d.study.folder`), and matches those
blocks itself that are missing.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import shutil
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from speckle3d.config import Config, config_from_toml
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.sweep import Sweep
from speckle3d.io.calibrations import apply_calibrations
from speckle3d.io.curves import read_curves
from speckle3d.io.hdf5 import make_folder, one_line, sha256_of
from speckle3d.io.load import load_landmarks, load_sweep, recording_files, recording_sha256
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.matching.blocks import Block, blocks_of
from speckle3d.pipeline import match_ahead
from speckle3d.scoring.displacements import drift_rows
from speckle3d.scoring.references import find_reference
from speckle3d.study.folder import BlockFiles
from speckle3d.study.images import Strip
from speckle3d.study.job import write_results
from speckle3d.study.request import Request, available_modes, require_possible
from speckle3d.study.results import SweepOutcome, json_text

DONE = "job.json"
"""File that is written last into a sweep's folder: with it the folder is whole."""

_TEMPORARY = re.compile(r"\.part-[0-9a-f]{8}-")
"""Prefix of temporary names."""


@dataclass(frozen=True)
class SweepJob:
    """One sweep to reconstruct, with everything that determines the result.

    Attributes
    ----------
    modes : tuple of str, or None
        Beside `image`; None for all that the sweep has sensors for.
    key : str
        SHA-256 of the input's bytes, configuration, version, modes, reference, curves and calibrations.
    stamp : tuple of int
        Size and time of change of the input from before it was hashed; while they are the same, so are its
        bytes.
    crossing : path, optional
        The crossing sweep, if mode `crossed` is asked for.
    """

    name: str
    path: Path
    folder: Path
    curves: Path
    settings_toml: str
    modes: tuple[str, ...] | None
    reference: str | None
    calibrations: tuple[Path, ...]
    sha256: str
    key: str
    frames: int
    stamp: tuple[int, int]
    crossing: Path | None = None


@dataclass(frozen=True)
class BlockJob:
    """One block of a long sweep to match."""

    sweep: SweepJob
    block: Block


@dataclass(frozen=True)
class BlockOutcome:
    """What became of one block; `reason` says why it failed, and is empty if it did not."""

    name: str
    frames: int
    reason: str = ""
    seconds: float = 0.0
    skipped: bool = False


Task = SweepJob | BlockJob


def run_task(task: Task) -> SweepOutcome | BlockOutcome:
    """Do a sweep's or a block's job."""
    return run_block(task) if isinstance(task, BlockJob) else run_sweep(task)


def lost_task(task: Task, reason: str) -> SweepOutcome | BlockOutcome:
    """Outcome of a job that was lost with its workers."""
    return lost_block(task, reason) if isinstance(task, BlockJob) else lost(task, reason)


def plan_sweep(
    name: str,
    path: Path,
    directory: Path,
    curves: Path | None,
    settings_toml: str,
    modes: tuple[str, ...] | None,
    reference: str | None,
    calibrations: tuple[Path, ...],
) -> SweepJob | SweepOutcome:
    """Find out what determines a sweep's results; an outcome at once if it cannot be opened."""
    path = path.resolve()
    found = (curves or path.parent / "curves.h5").resolve()
    try:
        stamp = _stamp(path)
        frames, sha256 = len(load_sweep(path)), recording_sha256(path)
        crossing = crossing_of(path) if "crossed" in (modes or ()) else None
        used = [sha256_of(each) for each in (found, *calibrations)]
        used += [] if crossing is None else [recording_sha256(crossing)]
    except Exception as error:  # noqa: BLE001 - one row that says why
        return SweepOutcome(name, path, "failed", _reason(error))
    parts = [sha256, settings_toml, version("speckle3d"), modes, reference, used]
    key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    folder = (directory / "sweeps" / f"{name}-{key[:8]}").resolve()
    mounted = tuple(each.resolve() for each in calibrations)
    if "crossed" in (modes or ()) and crossing is None:
        wanted = f"{path.stem}-crossing{path.suffix}"
        return SweepOutcome(
            name, path, "failed", f"mode crossed: expected a crossing sweep {wanted} beside it"
        )
    return SweepJob(
        name,
        path,
        folder,
        found,
        settings_toml,
        modes,
        reference,
        mounted,
        sha256,
        key,
        frames,
        stamp,
        crossing,
    )


def crossing_of(path: Path) -> Path | None:
    """The crossing sweep of ``SWEEP.h5``: ``SWEEP-crossing.h5`` beside it, and the other way round."""
    stem = path.stem.removesuffix("-crossing") if path.stem.endswith("-crossing") else f"{path.stem}-crossing"
    beside = path.with_name(f"{stem}{path.suffix}")
    return beside if beside.exists() else None


def plan_blocks(job: SweepJob) -> list[BlockJob]:
    """Blocks to match before a long sweep's own job; none of one that is one block, crossed or finished."""
    if job.crossing is not None:
        return []  # blocks keep a strip of every image, and crossing needs all of it
    blocks = blocks_of(job.frames, config_from_toml(job.settings_toml).trajectory.block_frames)
    return [BlockJob(job, block) for block in blocks] if len(blocks) > 1 and finished(job) is None else []


def run_block(job: BlockJob) -> BlockOutcome:
    """Match a block into its file unless it is there; whatever is wrong becomes the outcome's reason."""
    files, frames, began = block_files(job.sweep), job.block.stop - job.block.first, time.perf_counter()
    if files.has(job.block):
        return BlockOutcome(job.sweep.name, frames, skipped=True)
    try:
        _require_unchanged(job.sweep)
        settings = config_from_toml(job.sweep.settings_toml)
        sweep, _ = apply_calibrations(load_sweep(job.sweep.path), job.sweep.calibrations)
        require_possible(sweep, _modes(job.sweep, sweep, settings), job.sweep.reference, settings)
        strip = Strip(sweep, settings)
        matched = match_ahead(sweep, read_curves(job.sweep.curves), job.block, settings, strip.keep)
        _require_unchanged(job.sweep)
        seconds = time.perf_counter() - began
        files.write(job.block, matched, strip, seconds)
    except Exception as error:  # noqa: BLE001 - the sweep's own job will find the same, and say so
        return lost_block(job, _reason(error))
    return BlockOutcome(job.sweep.name, frames, seconds=seconds)


def lost_block(job: BlockJob, reason: str) -> BlockOutcome:
    """Outcome of a block that failed or was lost with its workers."""
    return BlockOutcome(job.sweep.name, job.block.stop - job.block.first, reason)


def block_files(job: SweepJob) -> BlockFiles:
    """Where a sweep's blocks are."""
    return BlockFiles(job.folder.parents[1] / "blocks" / job.folder.name, job.key)


def run_sweep(job: SweepJob) -> SweepOutcome:
    """Do a job unless it is done; whatever is wrong with the sweep becomes the outcome's reason."""
    files = block_files(job)
    held = finished(job)
    if held is not None:
        files.clear()
        return held
    # Another worker may be at the same sweep if this one was taken for dead: each has its own folder.
    part = job.folder.with_name(f".part-{secrets.token_hex(4)}-{job.folder.name}")
    began = time.perf_counter()
    try:
        _reconstruct(job, part, files)
        seconds = time.perf_counter() - began + files.spent_s
        (part / DONE).write_text(json.dumps({"key": job.key, "seconds": seconds}), encoding="utf-8")
        _move(part, job)
        files.clear()
    except Exception as error:  # noqa: BLE001
        # One broken sweep, or one bug that it reveals, must not stop the others.
        return lost(job, _reason(error))
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return _done(job, seconds)


def _reconstruct(job: SweepJob, part: Path, files: BlockFiles) -> None:
    _require_same(job)
    settings, sweep = config_from_toml(job.settings_toml), load_sweep(job.path)
    mounted, _ = apply_calibrations(sweep, job.calibrations)
    curves, modes = read_curves(job.curves), _modes(job, mounted, settings)
    make_folder(part)
    crossing = None if job.crossing is None else (load_sweep(job.crossing), job.crossing)
    request = Request(
        sweep, job.path, curves, tuple(modes), job.reference, settings, job.calibrations, crossing
    )
    write_results(request, part, None, files if crossing is None else None)
    reference = find_reference(mounted, job.reference)
    rows = []
    if reference is not None:
        poses = read_reconstruction(part / "reconstruction.h5", with_pairs=False).poses
        rows = drift_rows(mounted.grid, poses, reference, load_landmarks(job.path))
    (part / "drift.json").write_text(json_text(rows), encoding="utf-8")


def _modes(job: SweepJob, sweep: Sweep, settings: Config) -> list[str]:
    """Modes beside `image`, which every job has."""
    modes = available_modes(sweep, settings) if job.modes is None else job.modes
    return [mode for mode in modes if mode != "image"]


def _require_unchanged(job: SweepJob) -> None:
    """Refuse an input of other bytes; they are only read if the file's size or time has changed."""
    if _stamp(job.path) != job.stamp:
        _require_same(job)


def _require_same(job: SweepJob) -> None:
    if recording_sha256(job.path) != job.sha256:
        raise InvalidInputError(f"{job.path}: expected the file that the study began with, got another")


def _stamp(path: Path) -> tuple[int, int]:
    """Bytes of all files of a recording, and when the last of them was written, ns."""
    held = [file.stat() for file in recording_files(path)]
    return sum(each.st_size for each in held), max(each.st_mtime_ns for each in held)


def finished(job: SweepJob) -> SweepOutcome | None:
    """Outcome of a job whose folder is there already, whole; None otherwise."""
    try:
        held = json.loads((job.folder / DONE).read_text(encoding="utf-8"))
        return _done(job, float(held["seconds"]), skipped=True) if held["key"] == job.key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _move(part: Path, job: SweepJob) -> None:
    """Put a finished folder in its place, unless another worker's is there already."""
    if finished(job) is not None:
        return
    shutil.rmtree(job.folder, ignore_errors=True)
    try:
        os.rename(part, job.folder)
    except OSError:
        if finished(job) is None:
            raise


def _done(job: SweepJob, seconds: float, skipped: bool = False) -> SweepOutcome:
    folder = f"sweeps/{job.folder.name}"
    return SweepOutcome(
        job.name, job.path, "done", "", job.sha256, job.key, folder, seconds, job.frames, skipped
    )


def lost(job: SweepJob, reason: str) -> SweepOutcome:
    """Outcome of a job that failed or was lost with its workers; the reason leaves out temporary names."""
    told = _TEMPORARY.sub("", reason)
    return SweepOutcome(job.name, job.path, "failed", told, job.sha256, job.key, frames=job.frames)


def _reason(error: Exception) -> str:
    words = " ".join(one_line(error).split())
    if isinstance(error, OSError) and error.filename and not isinstance(error, Speckle3DError):
        words = f"{error.filename}: {words}"
    return words if isinstance(error, Speckle3DError) else f"{type(error).__name__}: {words}"
