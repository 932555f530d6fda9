"""Raw packages of Clarius handheld scanners: RF, I/Q or envelope, with the sensor inside the probe.

What is read, what is assumed and why is in ``docs/howto/clarius.md``, and with the code of each part.
"""
