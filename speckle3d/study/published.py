"""Tables 3 and 4 of Housden et al. 2008, as printed, and ours laid out beside them.

References
----------
.. [1] R. J. Housden et al., "Calibration of an orientation sensor for freehand 3D ultrasound and its use in a
   hybrid acquisition system", BioMedical Engineering OnLine 7:5, 2008.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from types import MappingProxyType

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.scoring.lengths import ModeError
from speckle3d.scoring.statistics import MeanInterval, mean_interval
from speckle3d.study.summary import plain

MODES = ("image", "pose", "orientation")
"""In the tables' order: image-based, six DOF correction, orientation correction."""

PUBLISHED: Mapping[tuple[str, str], tuple[tuple[float, float, float], tuple[float, float, float]]] = (
    MappingProxyType(
        {
            ("beef-1", "f"): ((13.1, 2.5, 12.5), (1.30, -0.06, -0.01)),
            ("beef-2", "f"): ((30.5, -2.9, 31.6), (1.50, -0.07, -0.09)),
            ("beef-3", "f"): ((26.3, 0.2, 26.5), (0.46, 0.03, 0.01)),
            ("beef-4", "f"): ((-19.9, 1.9, -18.3), (1.35, 0.01, 0.00)),
            ("beef-5", "f"): ((-6.8, 3.8, -8.0), (1.25, -0.09, -0.03)),
            ("beef-6", "f"): ((14.6, 2.9, 12.7), (0.71, -0.03, -0.01)),
            ("beef-6", "r"): ((15.6, 4.61, 16.0), (0.61, -0.01, -0.02)),
            ("beef-7", "f"): ((8.01, 0.6, 4.9), (0.14, 0.05, 0.09)),
            ("beef-7", "r"): ((29.0, -2.0, 26.7), (0.87, 0.11, 0.10)),
            ("beef-8", "f"): ((2.7, 2.2, 2.0), (0.67, 0.01, -0.02)),
            ("beef-8", "r"): ((-7.6, -1.0, -6.5), (0.53, -0.00, 0.01)),
            ("beef-9", "f"): ((23.9, -1.0, 25.5), (1.14, 0.07, 0.05)),
            ("beef-9", "r"): ((-21.7, 0.7, -23.4), (-0.05, 0.07, 0.07)),
            ("beef-10", "f"): ((3.0, 1.4, -1.6), (1.50, -0.03, -0.02)),
            ("beef-10", "r"): ((40.9, -0.1, 25.6), (2.21, 0.02, 0.03)),
            ("phantom", "f"): ((6.5, -1.1, 4.2), (-8.02, 0.03, -0.11)),
            ("phantom", "r"): ((6.1, -0.5, 4.7), (-0.43, -0.03, 0.00)),
        }
    )
)
"""By data set and part (f forward, r reverse): errors of length in per cent and of tilt in degrees, each for
the modes of `MODES`."""


@dataclass(frozen=True)
class Beside:
    """One mode's mean absolute errors over all parts: as published, and ours against each reference.

    Attributes
    ----------
    published_percent, published_deg : float
    length_percent, tilt_deg : mapping of str to MeanInterval
        By reference. Parts, not sweeps, are the units, as there are 17 in the tables.
    """

    mode: str
    published_percent: float
    published_deg: float
    length_percent: Mapping[str, MeanInterval]
    tilt_deg: Mapping[str, MeanInterval]


def beside(rows: Mapping[str, Sequence[ModeError]]) -> list[Beside]:
    """Means over all parts, by mode.

    Parameters
    ----------
    rows : mapping of str to sequence of ModeError
        Of all sweeps, by what they are compared with.
    """
    length, tilt = (np.abs([each[k] for each in PUBLISHED.values()]).mean(axis=0) for k in (0, 1))
    return [
        Beside(
            mode,
            float(length[k]),
            float(tilt[k]),
            {name: mean_interval(np.abs(_errors(found, mode)[:, 0])) for name, found in rows.items()},
            {name: mean_interval(np.abs(_errors(found, mode)[:, 1])) for name, found in rows.items()},
        )
        for k, mode in enumerate(MODES)
    ]


def text_beside(rows: Mapping[str, Mapping[str, Sequence[ModeError]]]) -> str:
    """Both tables, part by part, published | ours, and the means of absolute errors below.

    Parameters
    ----------
    rows : mapping of str to mapping of str to sequence of ModeError
        By reference, then by data set; the first reference's errors are listed part by part.
    """
    first = next(iter(rows))
    lines = [
        f"Errors as published (Housden 2008, tables 3 and 4) | in simulation, against the {first}.",
        "The published sweeps of beef are 1.5 to 4 mm long, these 10 or 20 mm.",
        "",
        f"{'data set':10}  {'length error, per cent':^45}  {'tilt error, degrees':^45}",
        f"{'':10}  " + "  ".join([f"{mode:^13}" for mode in MODES] * 2),
    ]
    for (name, part), published in PUBLISHED.items():
        ours = {row.mode: row for row in rows[first].get(name, ()) if row.part == part}
        length = [
            _pair(p, ours.get(m), "length_error_percent", 1) for m, p in zip(MODES, published[0], strict=True)
        ]
        tilt = [_pair(p, ours.get(m), "tilt_error_deg", 2) for m, p in zip(MODES, published[1], strict=True)]
        lines.append(f"{name + ' ' + part:10}  " + "  ".join(length + tilt))
    return "\n".join([*lines, "", *_means(rows)]) + "\n"


def json_beside(rows: Mapping[str, Mapping[str, Sequence[ModeError]]]) -> str:
    """The means of `beside` and every row, as JSON."""
    flat = {name: [row for some in found.values() for row in some] for name, found in rows.items()}
    contents = {
        "means": beside(flat),
        "rows": [
            {"reference": name, "sweep": sweep, **asdict(row)}
            for name, found in rows.items()
            for sweep, some in found.items()
            for row in some
        ],
    }
    return json.dumps(plain(contents), indent=2, allow_nan=False) + "\n"


def _means(rows: Mapping[str, Mapping[str, Sequence[ModeError]]]) -> list[str]:
    flat = {name: [row for some in found.values() for row in some] for name, found in rows.items()}
    lines = ["mean absolute error of all parts [95 % of bootstrap samples]"]
    for each in beside(flat):
        published = f"{each.published_percent:5.1f} %  {each.published_deg:6.3f} deg"
        lines.append(f"  {each.mode:12} published   {published}")
        for name in flat:
            percent, deg = _interval(each.length_percent[name], 2), _interval(each.tilt_deg[name], 3)
            lines.append(f"  {'':12} {name:10} {percent} %  {deg} deg")
    return lines


def _interval(found: MeanInterval, digits: int) -> str:
    if found.low is None or found.high is None:
        return f"{found.mean:6.{digits}f}"
    return f"{found.mean:6.{digits}f} [{found.low:.{digits}f}, {found.high:.{digits}f}]"


def _pair(published: float, ours: ModeError | None, name: str, digits: int) -> str:
    value = "missing" if ours is None else f"{getattr(ours, name):+.{digits}f}"
    return f"{published:+5.{digits}f} | {value:5}"


def _errors(rows: Sequence[ModeError], mode: str) -> FloatArray:
    """Length (per cent) and tilt (degrees) of a mode's rows, shape (n, 2)."""
    found = [(row.length_error_percent, row.tilt_error_deg) for row in rows if row.mode == mode]
    return np.array(found, dtype=float).reshape(-1, 2)
