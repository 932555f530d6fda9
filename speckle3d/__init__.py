"""Freehand 2-D ultrasound sweeps to measured 3-D, with no position sensor or a small orientation sensor.

The public names are listed once, in ``__init__.pyi``, and loaded when first used: importing the package loads
neither NumPy nor numba.
"""

import lazy_loader

_attribute, _names, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Load a public name, or the version, on first use."""
    if name == "__version__":
        from importlib.metadata import version  # 20 ms, which few need

        return version(__name__)
    return _attribute(name)


def __dir__() -> list[str]:
    return [*_names(), "__version__"]
