"""Studies of sweeps so long that they are matched in blocks of frames."""

import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from cluster_jobs import part_of_study

from speckle3d.config import Config
from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.io.sweep_writer import write_sweep
from speckle3d.matching.blocks import blocks_of
from speckle3d.study.compare import MATCHING_SHARE, StudyProgress, compare_sweeps
from speckle3d.study.job import run_job
from speckle3d.study.request import SUBSET
from speckle3d.study.results import SweepOutcome
from speckle3d.study.schedulers import InProcess, OnCluster, local_cluster
from speckle3d.study.sweepjob import BlockOutcome, plan_blocks, plan_sweep, run_block, run_sweep

# Dask's processes leave sockets to the garbage collector when one is killed.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)

FRAMES = 42
CONFIG = Config.model_validate({"trajectory": {"block_frames": 14}})
BLOCKS = ["block-0", "block-14", "block-28"]


class Noted:
    """A scheduler whose jobs write down that they are run."""

    def __init__(self, where, folder, dies_at=None):
        self.where, self.folder, self.dies_at = where, folder, dies_at
        self.workers = where.workers

    def run(self, function, jobs, lost, after=None):
        noted = partial(part_of_study, folder=str(self.folder), dies_at=self.dies_at)
        return self.where.run(noted, jobs, lost, after)

    def runs(self):
        return {path.stem: len(path.read_text().split()) for path in self.folder.glob("*.runs")}


@pytest.fixture(scope="module")
def path(tmp_path_factory, shipped):
    """The first frames of the shipped sweep, 26 vectors of 1000 samples."""
    folder = tmp_path_factory.mktemp("sweeps")
    shutil.copy(shipped / "curves.h5", folder)
    sweep = load_sweep(shipped / "phantom.h5")
    write_sweep(
        folder / "long.h5",
        replace(
            sweep,
            frames=np.stack([sweep.frames[i][:26, :1000] for i in range(FRAMES)]),
            grid=replace(sweep.grid, vectors=26, samples=1000),
            frame_time_s=sweep.frame_time_s[:FRAMES],
            truth=sweep.truth[:FRAMES],
        ),
    )
    return folder / "long.h5"


@pytest.fixture(scope="module")
def streamed(path, tmp_path_factory):
    """What the sweep gives in one go, without any files between."""
    folder = tmp_path_factory.mktemp("streamed")
    curves = read_curves(path.parent / "curves.h5")
    run_job(load_sweep(path), path, curves, folder, [SUBSET, "orientation", "pose", "fused"], config=CONFIG)
    return results(folder)


@pytest.fixture
def job(path, tmp_path):
    return planned(path, tmp_path)


def planned(path, folder):
    return plan_sweep("long", path, folder, None, CONFIG.to_toml(), None, None, ())


def results(folder):
    """What a sweep's folder holds, to the last bit."""
    found = read_reconstruction(folder / "reconstruction.h5")
    held = {mode: poses.as_matrix().tobytes() for mode, poses in found.poses.items()}
    held["pairs"] = [found.pairs.first.tobytes(), found.pairs.covariance.tobytes()]
    held["trust"] = found.trust.covariance.tobytes()
    held["picture"] = (folder / "reslice.png").read_bytes()
    return held


def only_folder(directory):
    (folder,) = (directory / "sweeps").iterdir()
    return folder


def test_blocks_in_process_give_the_bits_of_one_stream_and_leave_nothing(path, streamed, tmp_path):
    seen, where = [], Noted(InProcess(), tmp_path)
    found = compare_sweeps(
        [path],
        tmp_path / "out",
        config=CONFIG,
        scheduler=where,
        progress=lambda at: seen.append((at.blocks, at.done, at.done_frames)),
    )
    assert results(only_folder(found.directory)) == streamed
    assert where.runs() == dict.fromkeys([*BLOCKS, "long"], 1)
    assert sorted(each.name for each in found.directory.iterdir()) == [
        ".lock", "study.json", "sweeps", "table.csv", "table.txt",
    ]  # fmt: skip
    assert [blocks for blocks, _, _ in seen] == [3, 2, 1, 0, 0]
    assert [done for _, done, _ in seen] == [0, 0, 0, 0, 1]
    assert [frames for _, _, frames in seen] == pytest.approx(
        [14 * MATCHING_SHARE * k for k in range(4)] + [FRAMES]
    )
    # What the blocks took is part of what the sweep took.
    stages = json.loads((only_folder(found.directory) / "summary.json").read_text())["sweeps"][0]["details"]
    assert found.outcomes[0].seconds > stages["seconds_by_stage"]["in-plane motion and correlation"]


@pytest.mark.slow
def test_a_worker_killed_in_a_block_costs_only_that_block(path, streamed, tmp_path):
    with local_cluster(2) as client:
        # In the middle of the second block.
        where = Noted(OnCluster(client), tmp_path, dies_at=20)
        found = compare_sweeps([path], tmp_path / "out", config=CONFIG, scheduler=where)
    assert (tmp_path / "died").exists()
    runs = where.runs()
    assert (runs["block-14"], runs["block-28"], runs["long"]) == (2, 1, 1)
    # Asked again for what it found, if that went with the worker: it is on disk.
    assert runs["block-0"] in (1, 2)
    assert results(only_folder(found.directory)) == streamed
    assert not (found.directory / "blocks").exists()


def test_a_study_started_again_matches_only_the_blocks_that_are_missing(path, streamed, tmp_path):
    class Interrupted(InProcess):
        def run(self, *arguments):
            for number, result in super().run(*arguments):
                yield number, result
                if number == 1:
                    raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare_sweeps([path], tmp_path, config=CONFIG, scheduler=Interrupted())
    (folder,) = (tmp_path / "blocks").iterdir()
    first, _ = sorted(folder.iterdir())
    # The disk lost the end of one.
    first.write_bytes(first.read_bytes()[:-100])
    done = []
    compare_sweeps([path], tmp_path, config=CONFIG, scheduler=Seen(done))
    assert [each.skipped for each in done] == [False, True, False, False]
    assert results(only_folder(tmp_path)) == streamed
    assert compare_sweeps([path], tmp_path, config=CONFIG).outcomes[0].skipped


class Seen(InProcess):
    """Keeps what comes back."""

    def __init__(self, seen):
        object.__setattr__(self, "seen", seen)

    def run(self, *arguments):
        for number, result in super().run(*arguments):
            self.seen.append(result)
            yield number, result


def test_a_sweep_does_the_blocks_itself_that_are_not_there(job, streamed):
    """As when workers do not see each other's disks."""
    (_, second, _) = plan_blocks(job)
    assert run_block(second).reason == ""
    assert run_block(second).skipped
    assert run_sweep(job).status == "done"
    assert results(job.folder) == streamed
    assert plan_blocks(job) == []


def test_blocks_of_another_job_are_not_taken(job):
    (block, *_) = plan_blocks(job)
    run_block(block)
    other = replace(block, sweep=replace(job, key="0" * 64))
    assert not run_block(other).skipped


def test_usual_sweeps_are_one_job(path, tmp_path):
    job = plan_sweep("long", path, tmp_path, None, Config().to_toml(), None, None, ())
    assert len(blocks_of(job.frames, Config().trajectory.block_frames)) == 1
    assert plan_blocks(job) == []


def test_what_is_wrong_with_a_sweep_is_found_before_its_blocks_are_matched(path, tmp_path, monkeypatch):
    bare, alone = tmp_path / "bare.h5", replace(load_sweep(path), orientation=None, tracker=None)
    write_sweep(bare, alone)
    shutil.copy(path.parent / "curves.h5", tmp_path)
    monkeypatch.setattr("speckle3d.pipeline.match_block", None)
    seen = []
    found = compare_sweeps([bare], tmp_path / "out", ["pose"], config=CONFIG, scheduler=Seen(seen))
    assert ["tracker" in each.reason for each in seen] == [True] * 4
    assert found.outcomes[0].reason == seen[-1].reason


def test_a_sweep_whose_block_is_lost_is_one_row_that_says_why(path, tmp_path):
    class Losing(InProcess):
        def run(self, function, jobs, lost, after=None):
            (last,) = [number for number, before in after.items() if before]
            assert list(after[last]) == [0, 1, 2]
            yield from ((number, lost(jobs[number], "every worker died")) for number in (1, last))

    found = compare_sweeps([path], tmp_path, config=CONFIG, scheduler=Losing())
    assert [(each.status, each.reason) for each in found.outcomes] == [("failed", "every worker died")]
    assert "every worker died" in found.table


def test_a_file_that_changed_under_its_blocks_is_refused(path, tmp_path):
    mine = tmp_path / "mine.h5"
    shutil.copy(path, mine)
    shutil.copy(path.parent / "curves.h5", tmp_path)
    block, *_ = plan_blocks(planned(mine, tmp_path))
    # Written anew, it is still the same file.
    shutil.copy(path, mine)
    assert run_block(block).reason == ""
    with mine.open("ab") as stream:
        stream.write(b"more")
    shutil.rmtree(tmp_path / "blocks")
    assert run_block(block).reason.startswith(str(mine))


def test_time_left_counts_blocks_as_part_of_their_sweep(tmp_path):
    at = StudyProgress(sweeps=2, frames=1100, blocks=2)
    at.add(BlockOutcome("long", 500, seconds=25.0), 2)
    # 25 s for 250 frames' worth of work: 850 are left, on both workers.
    assert MATCHING_SHARE == 0.5
    assert at.remaining_s == pytest.approx(0.1 * 850 / 2)
    at.add(BlockOutcome("long", 500, skipped=True), 2)
    assert at.remaining_s == pytest.approx(0.1 * 600 / 2)
    at.add(SweepOutcome("long", tmp_path, "done", seconds=100.0, frames=1000), 2)
    assert (at.remaining_s, at.done_frames) == pytest.approx((0.1 * 100, 1000))
    at.add(SweepOutcome("short", tmp_path, "done", seconds=10.0, frames=100), 2)
    assert (at.remaining_s, at.done_frames) == pytest.approx((0.0, 1100))
