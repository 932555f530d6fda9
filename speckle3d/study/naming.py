"""What the sweeps of a study are called."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path


def named(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Each file once, by its stem, or with as many of its folders as tell it from others of that stem.

    Names depend on the files alone, not on their order: a study given again in another order is the same.
    """
    given = {path.resolve(): path.absolute() for path in reversed(paths)}
    files = [given[target] for target in dict.fromkeys(path.resolve() for path in paths)]
    stems = Counter(path.with_suffix("") for path in files)
    words = [
        # Beside another that differs in its suffix alone, the suffix belongs to the name.
        [*path.parts[1:-1], path.stem if stems[path.with_suffix("")] == 1 else path.name.replace(".", "-")]
        for path in files
    ]
    depth = [1] * len(files)
    names = _joined(words, depth)
    while alike := [i for i, n in enumerate(names) if names.count(n) > 1 and depth[i] < len(words[i])]:
        for i in alike:
            depth[i] += 1
        names = _joined(words, depth)
    # Folders joined may still be alike: a-b/c and a/b-c.
    unique = [n if names.count(n) == 1 else f"{n}-{_mark(p)}" for n, p in zip(names, files, strict=True)]
    return list(zip(unique, files, strict=True))


def _joined(words: Sequence[Sequence[str]], depth: Sequence[int]) -> list[str]:
    return ["-".join(each[-d:]) for each, d in zip(words, depth, strict=True)]


def _mark(path: Path) -> str:
    return hashlib.sha256(str(path).encode()).hexdigest()[:6]
