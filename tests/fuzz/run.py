"""Fuzz everything the package reads, for as long as there is time.

    python tests/fuzz/run.py                                   # all kinds, until Ctrl-C
    python tests/fuzz/run.py --kinds sweep tum --cases 10000   # seeds 0 to 9999 of two kinds
    python tests/fuzz/run.py --case sweep 4711 --keep case     # one again, in this process, its file kept

A case is a whole file, damaged as its seed says. It must be read, or refused by an error of the package in
one line; without another exception or warning, a crash of the interpreter, a hang, or more memory than twice
the file and a constant. Cases run in processes of their own; those that fail are kept in --failures.
"""

import argparse
import collections
import faulthandler
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from pathlib import Path
from queue import Empty, Queue

import numpy as np

# The examples are those of the tests.
sys.path[0] = str(Path(__file__).resolve().parents[1])

BATCH = 2000
LONGEST_MESSAGE = 2000
GOOD = ("read", "refused")


def prepare(kind, seed, kept, folder):
    """Write the damaged file of a seed, beside whole ones; returns its path."""
    from fuzz.kinds import kinds

    rng = np.random.default_rng([*kind.encode(), seed])
    mains, contents = kept
    put(contents, folder)
    path = folder / mains[int(rng.integers(0, len(mains)))]
    kinds()[kind].damage(rng, path)
    return path


def put(contents, folder):
    for name, content in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def examples(kind):
    """Names of whole files, and the bytes of these and of what lies beside them by name."""
    from fuzz.kinds import kinds

    with tempfile.TemporaryDirectory() as folder:
        mains = [str(path.relative_to(folder)) for path in kinds()[kind].write(Path(folder))]
        files = [path for path in sorted(Path(folder).rglob("*")) if path.is_file()]
        return sorted(mains), {str(path.relative_to(folder)): path.read_bytes() for path in files}


def outcome(kind, path):
    """Read a damaged file: "read", "refused", or what went wrong, and the words to it."""
    from speckle3d.core.errors import Speckle3DError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            kind.read(path)
    except Speckle3DError as error:
        words = str(error)
        if not words or len(words) > LONGEST_MESSAGE or not words.isprintable():
            return "unreadable message", repr(words)[:300]
        return "refused", words
    except BaseException:  # noqa: BLE001 - whatever it is, it is what is looked for
        return "exception", traceback.format_exc()
    return "read", ""


def memory_bytes(field):
    """A figure of this process's memory on Linux; 0 elsewhere."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(field)), 0)


def forget_peak():
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


def work(name, first, count, measured):
    """Run cases and say on stdout how each went, for `watch`."""
    from fuzz.kinds import kinds

    faulthandler.enable()
    kind, kept = kinds()[name], examples(name)
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        put(kept[1], whole)
        for each in kept[0]:
            # So that numba's kernels and imports are no case's time or memory.
            found, words = outcome(kind, whole / each)
            if found != "read":
                raise RuntimeError(f"{name}: {each}: expected a whole file to be read, got {found}: {words}")
        for seed in range(first, first + count):
            print(f"begin {seed}", flush=True)
            place = Path(folder) / "case"
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir()
            path = prepare(name, seed, kept, place)
            size = path.stat().st_size
            before = 0
            if measured:
                forget_peak()
                before = memory_bytes("VmRSS")
            found, words = outcome(kind, path)
            grown = memory_bytes("VmHWM") - before if measured else 0
            if found in GOOD and grown > 2 * size + kind.beside_bytes:
                found, words = "memory", f"{grown} bytes for a file of {size}"
            said = "" if found in GOOD else words.encode().hex()
            print(f"end {seed} {found.replace(' ', '-')} {said}", flush=True)


def lines_of(stream, lines):
    """Pass lines on as they come; an empty one at the end."""
    for line in stream:
        lines.put(line)
    lines.put("")


def watch(name, first, count, measured):
    """Run seeds in other processes; returns counts of outcomes, and (seed, what, words) of failures."""
    counts, failures, at = collections.Counter(), [], first
    while at < first + count:
        rest = (str(at), str(first + count - at), str(int(measured)))
        command = [sys.executable, __file__, "--work", name, *rest]
        with (
            tempfile.TemporaryFile() as errors,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
        ):
            found, at, running = follow(name, process, at)
            process.wait()
            for seed, what, words in found:
                counts[what] += 1
                if what not in GOOD:
                    failures.append((seed, what, words))
            if at < first + count:
                errors.seek(0)
                text = errors.read().decode("utf-8", "replace")
                if running is None or running < at:
                    raise RuntimeError(f"{name}: the worker died between cases:\n{text}")
                what = "hang" if process.returncode == -9 else "crash"
                counts[what] += 1
                failures.append((running, what, f"exit code {process.returncode}\n{text[:4000]}"))
                at = running + 1
    return counts, failures


def follow(name, process, at):
    """Read what a worker says until it ends or hangs; returns outcomes, the next seed and the last begun."""
    from fuzz.kinds import kinds

    limit, lines = kinds()[name].seconds, Queue()
    threading.Thread(target=lines_of, args=(process.stdout, lines), daemon=True).start()
    found, running = [], None
    while True:
        try:
            # The first case waits for imports and kernels.
            word, *rest = lines.get(timeout=limit if running is not None else 300.0).split() or [""]
        except Empty:
            process.kill()
            return found, at, running
        if word == "begin":
            running = int(rest[0])
        elif word == "end":
            words = bytes.fromhex(rest[2]).decode() if len(rest) > 2 else ""
            found.append((running, rest[1].replace("-", " "), words))
            at = running + 1
        else:
            return found, at, running


def file_failure(folder, name, seed, what, words):
    """Keep a case that failed: its file, and what happened."""
    place = folder / f"{name}-{seed}"
    place.mkdir(parents=True, exist_ok=True)
    try:
        prepare(name, seed, examples(name), place)
    finally:
        (place / "what.txt").write_text(f"{what}\n{words}\n", encoding="utf-8")


def fuzz(names, cases, first, seconds, folder, measured):
    """Go round the kinds, a batch each, until cases or time are used up; returns whether all went well."""
    end = time.monotonic() + seconds
    done = dict.fromkeys(names, 0)
    total = {name: collections.Counter() for name in names}
    seen = 0
    while any(done[name] < cases for name in names) and time.monotonic() < end:
        for name in names:
            count = min(BATCH, cases - done[name])
            if count <= 0 or time.monotonic() >= end:
                continue
            begin = time.monotonic()
            counts, failures = watch(name, first + done[name], count, measured)
            spent = time.monotonic() - begin
            done[name] += count
            total[name] += counts
            for seed, what, words in failures:
                seen += 1
                print(f"{name} {seed}: {what}: {' '.join(words.split())[-200:]}")
                file_failure(folder, name, seed, what, words)
            tally = ", ".join(f"{n} {what}" for what, n in sorted(total[name].items()))
            seeds = f"seeds {first} to {first + done[name] - 1}"
            print(f"{name}: {seeds}: {tally} ({spent:.0f} s for the last {count})", flush=True)
    return seen == 0


def main():
    from fuzz.kinds import kinds

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kinds", nargs="+", default=list(kinds()), choices=list(kinds()))
    parser.add_argument("--cases", type=int, default=10**9, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--failures", type=Path, default=Path("fuzz-failures"))
    parser.add_argument("--unmeasured", action="store_true", help="leave memory unwatched: faster")
    parser.add_argument("--case", nargs=2, metavar=("KIND", "SEED"))
    parser.add_argument("--keep", type=Path, help="where to leave the file of --case")
    parser.add_argument("--work", nargs=4, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        name, first, count, measured = given.work
        work(name, int(first), int(count), bool(int(measured)))
        return 0
    if given.case:
        name, seed = given.case[0], int(given.case[1])
        with tempfile.TemporaryDirectory() as folder:
            place = given.keep or Path(folder)
            path = prepare(name, seed, examples(name), place)
            found, words = outcome(kinds()[name], path)
            print(f"{path}\n{found}\n{words}")
        return 0 if found in GOOD else 1
    return (
        0
        if fuzz(given.kinds, given.cases, given.first, given.seconds, given.failures, not given.unmeasured)
        else 1
    )


if __name__ == "__main__":
    sys.exit(main())
