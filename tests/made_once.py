"""Folders that are dear to make, made by the first of several test processes and used by all."""

import fcntl
import os


def made_once(tmp_path_factory, name, make):
    """Folder of a name that `make` has filled, in this run of the tests; nothing may change it afterwards."""
    base = tmp_path_factory.getbasetemp()
    return made_in(base.parent if "PYTEST_XDIST_WORKER" in os.environ else base, name, make)


def made_in(root, name, make):
    """Folder `name` of `root` that `make` has filled, now or before."""
    folder, marker = root / name, root / f"{name}.made"
    with open(root / f"{name}.lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not marker.exists():
            folder.mkdir(exist_ok=True)
            make(folder)
            marker.touch()
    return folder
