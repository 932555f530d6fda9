"""Places of numbers in the arrays of the heading's filter."""

# -- a bin: a quarter of a second of steps

SPAN, RESTS, SEEN, SLIP, BIAS_VARIANCE, BIAS_CHANGE = 0, 1, 2, 3, 4, 5
READING, POSE, LATE, TILT, CORRECTION = 8, 11, 20, 23, 24
BIN = 33
"""s; flags of rest and of a reading; variance of the level axes' slip about up, rad^2; variance of the
gyroscope's bias, rad^2/s^2, and its change, rad/s (three); the mean field in the level axes, over its norm
(three); mean level axes from the sensor's (nine); derivative of the reading by the
magnetometer's lag, 1/s (three); variance of the level axes' tilt, rad^2; turn by which corrections of it
turned them (nine)."""

# -- a model of the field

STRAY, STRAY_S, IRON_PRIOR, IRON_JUMP, AFTER_S = 0, 1, 2, 3, 4
MODEL = 5
"""Deviation of the field from the place's, as a fraction of its norm, and how long it persists, s; deviation
of the field of iron on the sensor at the start, and after it was put on or off (zero: never); how long the
sensor must have moved before the field is used."""

# -- what all models share

PLACE, FIRST_PLACE, FIRST_STRAY, WHITE, BIAS_S, ROOM, ROOM_WALK = 0, 1, 2, 3, 4, 5, 6
FREEDOM, LAG_S, OUTLIER, HOLD_S = 7, 8, 9, 10
SHARED = 11
"""Constants of all models: see `xsens.fusion.heading`."""

# -- state of a model's filter

OF_ROOM, GYRO_BIAS, IRON, OF_PLACE, OF_STRAY, OF_LAG = 0, 3, 6, 9, 12, 15
STATES = 16
"""The room's field (level axes); what is left of the gyroscope's bias (sensor axes); the field of iron
(sensor axes); what the place adds to the room's, and the stray (level axes); the magnetometer's lag, s. All
fields are fractions of the field's norm: at the start, or in a recording its median."""

BEGUN, RAN, RESTED, HOLDING, MOVED = 0, 1, 2, 3, 4
FLAGS = 5
"""Whether the filter has begun in this stretch, and ever; whether the last bin was at rest; how long iron is
still being put on, s; how long the sensor has moved in all, s."""

# -- what is found in a bin

FOUND_TURN, FOUND_VARIANCE, EVIDENCE, TRUST = 0, 1, 2, 3
FOUND = 4
"""Angle from the level axes to north, and its variance; logarithm of the reading's density, but for a
constant, NaN where there is none; its weight, 0 to 1."""
