"""Kill -9 at random moments: what is left is one result, old or new, and the next run makes it whole.

Run: ``python tests/benchmarks/bench_kill.py [MOMENTS] [SEED] [COMMAND...]`` (100 and 1; about half an hour on
an idle machine). Each moment: a folder that holds an earlier result, the public command in a process of its
own (with its workers), and SIGKILL to all of them at a time drawn evenly from zero to what the command took
undisturbed. Then every file must be that of the earlier result or all of them those of the new one; the
command run again must succeed, give what an undisturbed run gives (to the last bit but for times), and leave
no temporary file. A set of files that was caught between its first and its last rename is counted: of it some
files are in place, and the others wait in a hidden folder for the next run.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

DRIFT = ("--drift", "orientation", "--drift", "pose")
SMALL = ("--vectors", "26", "--samples", "1800", "--length-mm", "3", "--frames", "24")
PLANE = ("--preset", "plane", "--vectors", "40", "--frames", "60", "--duration-s", "12", "--reflector", "bar")
STEPPED = ("--preset", "stepped", "--steps", "15", "--step-mm", "0.06", "--blocks", "2")
BLOCKS = "[trajectory]\nblock_frames = 12\n"
TIMES = ("seconds", "seconds_by_stage")
TEMPORARY = re.compile(r"\.(part|done)-")
Digests = dict[str, str]


@dataclass(frozen=True)
class Case:
    """A command, and which of the files that it writes belong together.

    Attributes
    ----------
    old, new : arguments of the command; ``{out}`` is the folder of results
    together : names of files that are of one result
    derived : names of files made from them afterwards, absent while they are being made
    apart : files that may be of either result, each for itself
    """

    old: tuple[str, ...]
    new: tuple[str, ...]
    together: tuple[str, ...]
    derived: tuple[str, ...] = ()
    apart: Callable[[str], bool] = field(default=lambda name: False)
    fresh: bool = False
    weight: int = 2


def cases(inputs: Path) -> dict[str, Case]:
    """All commands, and what is to be killed of them."""

    def pair(*words: str, first: str, second: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        made = [tuple(word.format(i=inputs, n=n, out="{out}") for word in words) for n in (first, second)]
        return made[0], made[1]

    results = ("reconstruction.h5", "summary.json", "table.txt", "table.csv", "drift.png", "reslice.png")
    reconstruct = pair("reconstruct", "{i}/s{n}.h5", "-o", "{out}", *DRIFT, first="5", second="6")
    study = ("compare", "{i}/s7.h5", "{i}/s{n}.h5", "-o", "{out}", "--config", "{i}/blocks.toml")
    compare = pair(*study, first="5", second="6")
    held = {
        "apart": lambda name: name.startswith("sweeps/"),
        "together": ("study.json", "table.txt", "table.csv"),
        "derived": ("report.html", "overview.png"),
        "weight": 1,  # it takes several times as long
    }
    crossed = ("simulate", "{out}/a.h5", *SMALL[:6], "--preset", "crossed", "--frames", "12", "--seed", "{n}")
    beside = ("c.h5", "c.txt", "c.png")
    found = {
        "reconstruct over results": Case(*reconstruct, results),
        "reconstruct into a new folder": Case(*reconstruct, results, fresh=True),
        "compare": Case(*compare, **held),
        "compare --workers 2": Case(compare[0], (*compare[1], "--workers", "2"), **held),
        "simulate": Case(*pair(*crossed, first="3", second="4"), ("a.h5", "a-crossing.h5")),
    }
    for suffix in ("nrrd", "nii.gz"):
        words = ("volume", "{i}/r{n}/reconstruction.h5", "-o", "{out}/v." + suffix, "--voxel-mm", "0.1")
        found[f"volume .{suffix}"] = Case(*pair(*words, first="5", second="6"), (f"v.{suffix}",))
    words = ("scene", "{i}/r{n}/reconstruction.h5", "-o", "{out}/scene", "--voxel-mm", "0.2", "--images")
    files = ("volume-{}.nrrd", "state-{}.seg.nrrd", "outlines-{}.vtk", "first-frame-{}.tfm",
             "images-{}.seq.nrrd", "poses-{}.seq.mha", "scene.mrml")  # fmt: skip
    scene = tuple(f"scene/{name.format('image')}" for name in files)
    found["scene over a scene"] = Case(*pair(*words, first="5", second="6"), scene)
    found["scene into a new folder"] = Case(*pair(*words, first="5", second="6"), scene, fresh=True)
    for kind in ("plane", "orientation"):
        words = ("calibrate", kind, "{i}/plane{n}.h5", "-o", "{out}/c.h5")
        found[f"calibrate {kind}"] = Case(*pair(*words, first="8", second="9"), beside)
    words = ("calibrate", "curves", "{i}/stepped{n}.h5", "-o", "{out}/c.h5")
    found["calibrate curves"] = Case(*pair(*words, first="8", second="9"), ("c.h5",))
    return found


def make_inputs(chosen: Iterable[Case], inputs: Path) -> None:
    """Make the files that commands read."""
    words = {word for case in chosen for word in (*case.old, *case.new)}
    for name in sorted({Path(word).relative_to(inputs).parts[0] for word in words if str(inputs) in word}):
        make_input(inputs / name)


def make_input(path: Path) -> None:
    """Make one file, and before it those that it is made from."""
    if path.exists():
        return
    seed, beside = path.stem[-1], path.parent
    if path.name == "blocks.toml":
        path.write_text(BLOCKS)
    elif path.name == "curves.h5":
        make_input(beside / "stepped8.h5")
        command("calibrate", "curves", str(beside / "stepped8.h5"), "-o", str(path))
    elif path.name.startswith("r"):
        make_input(beside / f"s{seed}.h5")
        command("reconstruct", str(beside / f"s{seed}.h5"), "-o", str(path), *DRIFT)
    else:
        kind = {"plane": PLANE, "stepped": (*SMALL[:4], *STEPPED), "s": SMALL}[path.stem[:-1]]
        command("simulate", str(path), *kind, "--seed", seed)
        if kind == SMALL:
            make_input(beside / "curves.h5")


def command(*arguments: str) -> float:
    """Run the command undisturbed; returns its seconds."""
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "speckle3d.cli", *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)}: {done.stderr}")
    return time.perf_counter() - began


def killed(arguments: tuple[str, ...], after_s: float) -> bool:
    """Run the command and kill it with its workers; False if it ended before."""
    process = subprocess.Popen(
        [sys.executable, "-m", "speckle3d.cli", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return True
    return False


def digests(folder: Path) -> Digests:
    """Every file below a folder, by its content without times."""
    if not folder.is_dir():
        return {}
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): _digest(path) for path in paths}


def _digest(path: Path) -> str:
    data = path.read_bytes()
    if TEMPORARY.search(str(path)):
        return "temporary"
    if path.suffix == ".json":
        data = json.dumps(_without_times(json.loads(data))).encode()
    elif path.suffix == ".h5":
        return _content(path)
    elif path.suffix == ".html":
        data = re.sub(rb"<td[^>]*>[0-9.]+</td>", b"", data)
    return hashlib.sha256(data).hexdigest()


def _content(path: Path) -> str:
    """Digest of all values in an HDF5 file, however they lie in it."""
    found = hashlib.sha256()

    def add(name: str, node: h5py.Group | h5py.Dataset) -> None:
        attributes = {key: str(np.asarray(value).tolist()) for key, value in sorted(node.attrs.items())}
        found.update(f"{name} {attributes}".encode())
        if isinstance(node, h5py.Dataset):
            found.update(f"{node.shape} {node.dtype}".encode())
            values = np.asarray(node[()])
            found.update(repr(values.tolist()).encode() if values.dtype.kind == "O" else values.tobytes())

    try:
        with h5py.File(path) as file:
            add("/", file)
            file.visititems(add)
    except OSError as error:
        return f"broken: {error}"
    return found.hexdigest()


def _without_times(value: object) -> object:
    if isinstance(value, dict):
        return {name: _without_times(each) for name, each in value.items() if name not in TIMES}
    return [_without_times(each) for each in value] if isinstance(value, list) else value


def judge(case: Case, left: Digests, old: Digests, new: Digests) -> str:
    """Whether what a killed run left is "old", "new" or "moving"; anything else is an error."""
    hidden = re.compile(rf"{TEMPORARY.pattern}|^blocks/")
    seen = {name: value for name, value in left.items() if not hidden.search(name)}
    waiting = any(".done-" in name for name in left)
    for name, value in seen.items():
        if value not in (old.get(name), new.get(name)):
            return f"wrong: {name} is neither the old nor the new one"
    held = {name: seen.get(name) for name in case.together}
    is_old = all(value == old.get(name) for name, value in held.items())
    is_new = all(value == new.get(name) for name, value in held.items())
    for name in case.derived:
        if is_old and not is_new and seen.get(name) != old.get(name):
            return f"wrong: {name} is not that of the old result"
        if not is_old and seen.get(name) not in (None, new.get(name)):
            return f"wrong: {name} is not that of the new result"
    folders = {name.split("/")[1] for name in seen if name.startswith("sweeps/")}
    wanted = [name for name in new if name.startswith("sweeps/") and name.split("/")[1] in folders]
    gone = [n for n in (*old, *wanted) if case.apart(n) and n in new and n not in seen]
    if gone:
        return f"wrong: {gone[0]} is gone"
    if is_old or is_new:
        return "new" if is_new else "old"
    present = {name: value for name, value in held.items() if value is not None}
    if waiting and any(all(v == of.get(n) for n, v in present.items()) for of in (old, new)):
        return "moving"
    return f"wrong: mixed or half: {sorted(present)}"


def measure(name: str, case: Case, moments: int, rng: random.Random, base: Path) -> Counter[str]:
    """Kill a command at random moments."""
    earlier, reference = base / "earlier", base / "reference"
    for folder in (earlier, reference):
        folder.mkdir(parents=True)
    scratch = base / "scratch"

    def arguments(words: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(word.format(out=scratch / "out") for word in words)

    def restored() -> None:
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir()
        if not case.fresh:
            shutil.copytree(earlier / "out", scratch / "out")

    (scratch / "out").mkdir(parents=True)
    if not case.fresh:
        command(*arguments(case.old))
    shutil.copytree(scratch / "out", earlier / "out")
    restored()
    took_s = command(*arguments(case.new))
    old, new = ({} if case.fresh else digests(earlier / "out")), digests(scratch / "out")
    counts: Counter[str] = Counter()
    for _ in range(moments):
        restored()
        at_s = rng.uniform(0.0, took_s)
        ended = not killed(arguments(case.new), at_s)
        left = digests(scratch / "out")
        verdict = judge(case, left, old, new)
        rubbish = any(TEMPORARY.search(str(path)) for path in scratch.rglob("*"))
        command(*arguments(case.new))
        again = digests(scratch / "out")
        temporary = [str(path) for path in scratch.rglob("*") if TEMPORARY.search(path.name)]
        if again != new:
            verdict = f"wrong: run again, it gave another result: {set(again.items()) ^ set(new.items())}"
        elif temporary:
            verdict = f"wrong: run again, it left {temporary}"
        counts[verdict] += 1
        counts["ended before"] += ended
        counts["left temporary files"] += rubbish
        if verdict.startswith("wrong"):
            print(f"{name} killed after {at_s:.3f} of {took_s:.3f} s: {verdict}", flush=True)
    print(f"{name}: {took_s:.1f} s undisturbed; {moments} moments; {dict(counts)}", flush=True)
    return counts


def main(moments: int = 100, seed: int = 1, wanted: tuple[str, ...] = ()) -> int:
    """Share the moments among the commands; returns how many went wrong."""
    print(f"{moments} moments, seed {seed}, load {os.getloadavg()[0]:.1f}", flush=True)
    rng, total = random.Random(seed), Counter()
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs"
        inputs.mkdir()
        chosen = {
            n: c for n, c in cases(inputs).items() if not wanted or n.split(",")[0].split()[0] in wanted
        }
        make_inputs(chosen.values(), inputs)
        weights = sum(case.weight for case in chosen.values())
        for number, (name, case) in enumerate(chosen.items()):
            before = sum(each.weight for each in list(chosen.values())[:number])
            share = moments * (before + case.weight) // weights - moments * before // weights
            total += measure(name, case, share, rng, Path(folder) / f"case{number}")
    wrong = sum(count for verdict, count in total.items() if verdict.startswith("wrong"))
    print(f"in all {dict(total)}; wrong: {wrong}", flush=True)
    return wrong


if __name__ == "__main__":
    words = sys.argv[1:]
    sys.exit(bool(main(*map(int, words[:2]), wanted=tuple(words[2:]))))
