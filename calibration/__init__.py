"""Where the image is relative to the sensor, from images of phantoms (`job`) or of anything (`images`).

`chain` is the model that all phantoms share, `plane` its solver, `starts` where the solver starts, and
`identifiability` whether a scan's motion was sufficient. `plane`, `orientation`, `wires` and `nwires`
calibrate with one phantom each; `clock` finds a sensor's clock offset and `detection` phantoms in images.
"""
