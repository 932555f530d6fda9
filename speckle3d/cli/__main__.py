"""``python -m speckle3d.cli``."""

from speckle3d.cli import main

main()
