"""The same jobs in this process, in processes of this machine and on a Dask cluster."""

import re

import pytest
from cluster_jobs import double, failure_text, suicide

from speckle3d.study.schedulers import scheduler_for

pytestmark = pytest.mark.slow


def test_a_job_that_kills_its_worker_stops_no_other():
    with scheduler_for(None, 2) as where:
        results = list(where.run(suicide, [0, 1, 2, 3], failure_text))
    (reason,) = [r for r in results if isinstance(r, str)]
    assert re.match("1: its worker died", reason)
    assert sorted(r for r in results if isinstance(r, int)) == [0, 2, 3]


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_cluster_gives_the_same_results():
    dask = pytest.importorskip("distributed", reason="needs Dask (extra cluster)")
    cluster = dask.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with cluster, scheduler_for(cluster.scheduler_address, None) as where:
        assert sorted(where.run(double, [3, 1, 2], failure_text)) == [2, 4, 6]
        assert list(where.run(double, ["a", None], failure_text)).count("aa") == 1
