"""Every benchmark finds what it imports."""

import subprocess
import sys

OPTIONAL = {"cv2", "vtk"}
"""Peers that extra `bench` brings."""
IMPORT_ALL = """
import runpy, sys
for path in sys.argv[1:]:
    before = sys.path[:]
    sys.path.insert(0, path.rpartition("/")[0])
    if "--benchmark-only" in open(path, encoding="utf-8").read():
        sys.path.insert(0, "tests")  # as pytest does
    try:
        runpy.run_path(path)
    except ModuleNotFoundError as error:
        print(path, error.name, error)
    except ImportError as error:
        print(path, "-", error)
    sys.path[:] = before
"""


def test_every_benchmark_finds_what_it_imports(project):
    paths = sorted(map(str, (project / "tests" / "benchmarks").glob("bench_*.py")))
    assert paths
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL, *paths], cwd=project, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if line.split()[1] not in OPTIONAL] == []
