import os
import signal
import time
import urllib.request

import dask
import distributed
import psutil
import pytest
from cluster_jobs import double, lost, noted, suicide

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.study import schedulers
from speckle3d.study.schedulers import InProcess, OnCluster, local_cluster, scheduler_for

# Dask's processes leave sockets to the garbage collector when one is killed.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


KILLED = schedulers._KILLED


@pytest.fixture(scope="module")
def client():
    with local_cluster(2) as client:
        yield client


def test_in_process_runs_in_order():
    assert list(InProcess().run(double, [3, 1, 2], lost)) == [(0, 6), (1, 2), (2, 4)]


def test_a_cluster_gives_the_same_results(client):
    assert sorted(OnCluster(client).run(double, [3, 1, 2], lost)) == [(0, 6), (1, 2), (2, 4)]
    assert OnCluster(client).workers == 2


class Blaming(OnCluster):
    """Job 1 kills its worker; blamed are it, job 0, which waits there, and what depends on either."""

    def _arriving(self, function, jobs, before):
        for number, others in before.items():
            dies = number == 1 or (len(before) > 1 and (number == 0 or {0, 1} & set(others)))
            yield number, KILLED if dies else None, None if dies else function(jobs[number])


def test_jobs_blamed_for_a_death_are_tried_alone_and_only_what_waits_for_the_cause_is_lost():
    found = list(Blaming(None).run(double, [0, 1, 2, 3, 4], lost, {2: [1], 3: [0], 4: [0, 1]}))
    assert found == [(0, 0), (1, KILLED), (2, KILLED), (3, 6), (4, KILLED)]


@pytest.mark.slow
def test_a_job_that_kills_every_worker_is_lost_with_what_waits_for_it_and_the_others_are_not():
    # A job is given up after its second worker, not its fourth: each takes seconds to be replaced.
    with dask.config.set({"distributed.scheduler.allowed-failures": 1}), local_cluster(2) as client:
        found = dict(OnCluster(client).run(suicide, [0, 1, 2, 3], lost, {2: [1]}))
    assert (found[0], found[3]) == (0, 3)
    assert found[1] == found[2] == KILLED


@pytest.mark.slow
def test_a_cluster_without_workers_does_not_hold_a_study_for_ever(monkeypatch):
    monkeypatch.setattr(schedulers, "DESERTED_S", 2)
    with local_cluster(1) as alone:
        alone.cluster.scale(0)
        while alone.nthreads():
            time.sleep(0.05)
        found = dict(OnCluster(alone).run(double, [1, 2], lost))
    assert found == dict.fromkeys((0, 1), schedulers._DESERTED)


@pytest.mark.slow
def test_a_killed_worker_costs_only_the_job_it_was_at(tmp_path):
    for number in (0, 1):
        (tmp_path / f"{number}.go").touch()
    with local_cluster(2) as client:
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


def test_jobs_come_after_those_they_wait_for(client, tmp_path):
    after = {2: [0, 1], 3: [2]}
    for number in (0, 2, 3):
        (tmp_path / f"{number}.go").touch()
    results = OnCluster(client).run(noted, [(tmp_path, number) for number in range(4)], lost, after)
    assert next(results)[0] == 0
    while not (tmp_path / "1.runs").exists():
        time.sleep(0.02)
    time.sleep(0.3)
    # The second has not ended: nothing that waits for it has begun.
    assert {path.name for path in tmp_path.glob("*.runs")} == {"0.runs", "1.runs"}
    (tmp_path / "1.go").touch()
    assert [number for number, _ in results] == [1, 2, 3]


@pytest.mark.slow
def test_ctrl_c_reaches_the_study_alone_and_its_workers_say_nothing(capfd):
    with local_cluster(1) as client:
        for pid in client.run(os.getpid).values():
            os.kill(pid, signal.SIGINT)
        time.sleep(0.5)
        assert client.submit(double, 6, pure=False).result(timeout=60) == 12
    assert "Traceback" not in capfd.readouterr().err


def test_an_address_without_a_scheduler_is_one_line(monkeypatch):
    monkeypatch.setattr("speckle3d.study.schedulers.CONNECT_S", 0.5)
    with (
        pytest.raises(FileError, match=r"tcp://127\.0\.0\.1:9"),
        scheduler_for("tcp://127.0.0.1:9", None),
    ):
        pass


def test_an_existing_cluster_is_used_and_left_running(client):
    held = client.security
    key = {
        "client.cert": held.tls_client_cert,
        "client.key": held.tls_client_key,
        "ca-file": held.tls_ca_file,
    }
    with dask.config.set({f"distributed.comm.tls.{name}": value for name, value in key.items()}):  # noqa: SIM117
        with scheduler_for(client.scheduler.address, None) as there:
            assert dict(there.run(double, [4], lost)) == {0: 8}
    assert client.submit(double, 5).result(timeout=60) == 10


@pytest.mark.parametrize(("scheme", "other_key"), [("tcp", False), ("tls", False), ("tls", True)])
def test_without_the_key_nobody_gets_in(client, scheme, other_key):
    address = client.scheduler.address.replace("tls", scheme)
    key = distributed.Security.temporary() if other_key else None
    began = time.monotonic()
    with pytest.raises((OSError, TypeError)):
        distributed.Client(address, security=key, timeout=120).close()
    assert time.monotonic() - began < 60  # at once, however busy the machine is


def test_no_port_of_a_study_answers_in_plain_text_or_serves_a_page(client):
    processes = [os.getpid(), *client.run(os.getpid).values()]
    addresses = [
        client.scheduler.address,
        *client.nthreads(),
        *client.run(lambda dask_worker: dask_worker.nanny),
    ]
    assert all(address.startswith("tls://127.0.0.1:") for address in addresses)
    open_ports = {
        each.laddr
        for number in processes
        for each in psutil.Process(number).net_connections()
        if each.status == psutil.CONN_LISTEN
    }
    assert {each.ip for each in open_ports} == {"127.0.0.1"}
    assert len(open_ports) >= 3
    for _, port in open_ports:
        for page in ("info/main/workers.html", "json/counts.json", "metrics", "status"):
            with pytest.raises(OSError, match=r"404|reset|closed|Remote"):
                urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=5).close()


@pytest.mark.parametrize(("address", "workers"), [("tcp://a:1", 2), (None, 0)])
def test_contradicting_wishes_are_refused(address, workers):
    with pytest.raises(InvalidInputError, match="--workers"), scheduler_for(address, workers):
        pass


def test_one_worker_is_this_process():
    with scheduler_for(None, 1) as here:
        assert isinstance(here, InProcess)
