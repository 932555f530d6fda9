"""Raw packages of Clarius handheld scanners: RF, I/Q or envelope, with the sensor inside the probe.

What is read, what is assumed and why is in ``docs/howto/clarius.md``, and with the code of each part.
"""

from speckle3d.io.clarius.package import is_package
from speckle3d.io.clarius.reader import FORMAT, open_package, package_files
from speckle3d.io.readers import Reader

READER = Reader(FORMAT, is_package, open_package, companions=package_files)
