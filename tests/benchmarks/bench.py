"""What benchmarks have in common: the tests' examples on the path, the shipped data, the option ``--quick``.

Imported before NumPy: a team of threads slows small factorisations down.
"""

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
TESTS = Path(__file__).resolve().parents[1]
DATA = TESTS.parent / "data"
sys.path.insert(0, str(TESTS))


def parser_of(doc):
    """Parser of a benchmark's command line, described by the first line of its docstring."""
    return argparse.ArgumentParser(description=doc.splitlines()[0])


def parse_options(parser, **quick):
    """Parse the command line; with ``--quick``, `quick` stands in place of what was given."""
    changes = ", ".join(f"{name} {value}" for name, value in quick.items())
    parser.add_argument("--quick", action="store_true", help=f"only {changes}".replace("_", " "))
    options = parser.parse_args()
    if options.quick:
        vars(options).update(quick)
    return options
