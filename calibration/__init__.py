"""Calibration of a sensor's mounting, from images of phantoms or of any tissue (`images`).

`plane` is the model that all phantoms share, its least squares, and the plane itself; `solution` says which
frames count and how certain an answer is, `motion` whether a scan's motion was sufficient. `orientation`,
`wires` and `nwires` are the other phantoms; `clock` finds a sensor's clock offset, `detection` phantoms in
images.
"""
