import os
import signal
import time

import pytest
from cluster_jobs import double, lost, noted, suicide

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.study.schedulers import InProcess, OnCluster, local_cluster, remaining_s, scheduler_for

# Dask's processes leave sockets to the garbage collector when one is killed.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


@pytest.fixture(scope="module")
def client():
    with local_cluster(2) as client:
        yield client


def test_in_process_runs_in_order():
    assert list(InProcess().run(double, [3, 1, 2], lost)) == [(0, 6), (1, 2), (2, 4)]


def test_a_cluster_gives_the_same_results(client):
    assert sorted(OnCluster(client).run(double, [3, 1, 2], lost)) == [(0, 6), (1, 2), (2, 4)]
    assert OnCluster(client).workers == 2


def test_a_job_that_kills_every_worker_is_lost_and_the_others_are_not(client):
    found = dict(OnCluster(client).run(suicide, [0, 1, 2], lost))
    assert (found[0], found[2]) == (0, 2)
    assert "every worker that tried it died" in found[1]


def test_a_killed_worker_costs_only_the_job_it_was_at(client, tmp_path):
    client.wait_for_workers(2, timeout=30)
    for number in (0, 1):
        (tmp_path / f"{number}.go").touch()
    results = OnCluster(client).run(noted, [(tmp_path, number) for number in range(4)], lost)
    first = [next(results)[1], next(results)[1]]
    assert sorted(first) == [0, 1]
    while not (tmp_path / "2.runs").exists():
        time.sleep(0.02)
    os.kill(int((tmp_path / "2.runs").read_text()), signal.SIGKILL)
    for number in (2, 3):
        (tmp_path / f"{number}.go").touch()
    assert sorted(number for _, number in results) == [2, 3]
    runs = {number: len((tmp_path / f"{number}.runs").read_text().split()) for number in range(4)}
    assert runs == {0: 1, 1: 1, 2: 2, 3: 1}


def test_an_address_without_a_scheduler_is_one_line(monkeypatch):
    monkeypatch.setattr("speckle3d.study.schedulers.CONNECT_S", 0.5)
    with (
        pytest.raises(FileError, match="expected a Dask scheduler, got none"),
        scheduler_for("tcp://127.0.0.1:9", None),
    ):
        pass


def test_an_existing_cluster_is_used_and_left_running(client):
    with scheduler_for(client.scheduler.address, None) as there:
        assert dict(there.run(double, [4], lost)) == {0: 8}
    assert client.submit(double, 5).result(timeout=20) == 10


@pytest.mark.parametrize(("address", "workers"), [("tcp://a:1", 2), (None, 0)])
def test_contradicting_wishes_are_refused(address, workers):
    with pytest.raises(InvalidInputError, match="expected"), scheduler_for(address, workers):
        pass


def test_one_worker_is_this_process():
    with scheduler_for(None, 1) as here:
        assert isinstance(here, InProcess)


def test_time_left_is_by_frames_and_not_by_one_slow_sweep():
    # Rates 0.1, 0.1 and 5 s a frame: the median is 0.1; 200 frames on two workers.
    assert remaining_s([(100, 10.0), (50, 5.0), (10, 50.0)], 200, 2) == pytest.approx(10.0)
    assert remaining_s([], 200, 2) is None
