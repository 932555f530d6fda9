"""The orientation sensor: its messages, logs and orientation; usable without speckle3d's upper floors.

The public names are listed once, in ``__init__.pyi``, and loaded when first used: importing the package loads
neither NumPy nor SciPy. Its settings are frozen dataclasses that check themselves, not pydantic models as
elsewhere: the package is usable in a program without pydantic, whose import takes about 0.1 s.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
