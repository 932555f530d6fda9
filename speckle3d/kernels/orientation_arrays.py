"""Places of numbers in the arrays of the orientation filter.

Its kernels pass one array for the state, one row for a step and one for the limits: an array in a compiled
call is a dozen values, and a tuple of arrays as many for each, which took minutes to compile.
"""

SIZE = 13
"""Attitude, bias, velocity, bias by all observations, field's angle: see `xsens.fusion.errorstate`."""

SMOOTHED = 9
"""States that are smoothed: without the magnetometer there is one bias."""

# -- limits: constants of filter and field monitor, and those of the settings that they use

GRAVITY, GYRO_NOISE, GYRO_SCALE_NOISE, BIAS_WALK, SPEED_VARIANCE, REST_SPEED_VARIANCE = 0, 1, 2, 3, 4, 5
FORCE_NOISE, FIELD_SD, FIELD_PLACE_S, FIELD_NOISE, FIELD_OFF_S, REST_NOISE = 6, 7, 8, 9, 10, 11
REST_BIAS_VARIANCE, FIRST_S, STILL_RATE, STILL_FORCE, STILL_S, STILL_BIAS = 12, 13, 14, 15, 16, 17
REST_MEMORY_S, MAGNETIC = 18, 19
"""SI units; `MAGNETIC` is one or zero. See `FusionSettings`."""

SMOOTHING_S, UNDISTURBED_S, TURNING, LEARNT_S, STARTING_S, IRON_MEMORY_S, PROVED_S = (
    20,
    21,
    22,
    23,
    24,
    25,
    26,
)
IRON_PRIOR, UNEVEN, FIRST_LEARNT_S, FIRST_UNEVEN, STEEPEST, BETTER = 27, 28, 29, 30, 31, 32
NORM_TOLERANCE, DIP_TOLERANCE, MEMORY_S = 33, 34, 35
"""Of the field monitor; see `xsens.fusion.detectors`."""

LIMITS = 36

# -- field monitor

HORIZONTAL, VERTICAL, IRON, HAS, CONFIRMED = 0, 1, 2, 5, 6
FITTING, AGE, TURNED, SMOOTH_HORIZONTAL, SMOOTH_VERTICAL, IRON_KNOWN = 7, 8, 9, 10, 11, 12
"""Reference, with its iron's three components; what is known of it; the smoothed field; if iron is known."""

CANDIDATE, KNOWN, SUMS = 13, 31, 18
"""Two sets of sums over readings, and the length of one."""

MONITOR = 49

WEIGHT, SQUARE, MISFIT, SUM_TURN, BODY, WORLD = 0, 1, 2, 3, 12, 15
"""Within a set: of weights, squares, misfits, rotations (nine), and fields in both axes."""

CLEAN, RESTART, DISTURBS, VARIANCE, RESTARTED = 0, 3, 6, 7, 8
READING = 9
"""What is found of a reading: the field without iron and the room's new field, in the world's axes; whether
it is disturbed; the variance of its heading, rad^2; and whether the reference was replaced."""

# -- state of the filter, kept from one stretch to the next

RUNNING, STARTING, HEADING, STRAY, RESTING, DISTURBED, SPEED, BIAS, NORTH_BIAS = 0, 1, 2, 3, 4, 5, 6, 9, 12
REST_KNOWN, REST_RATE, REST_FORCE, STILL = 15, 16, 19, 22
START_S, START_FIELD_S, START_FORCE, START_FIELD = 23, 24, 25, 28
"""Flags, angles, velocity, both biases; rest detector; the start's means."""

LEVEL, START_TURN, BEFORE, FIELD_MONITOR = 31, 40, 49, 58
"""Level axes from the sensor's without the heading; a start's first axes from the present ones; level axes
before the step."""

STATE = FIELD_MONITOR + MONITOR

# -- a step: one increment, and the filter before and after it

DURATION, RATE, FIELD, ASSUMED, TURN = 0, 1, 4, 7, 10
"""s; mean gyroscope; mean field, NaN where there is none; the bias with which turns were summed; start from
end of the increment (nine)."""

STEP_START, PREDICTED, MATRIX = 19, 28, 37
"""World from sensor before the increment, after it (without the heading), and after its correction (nine)."""

STEP_START_BIAS, PREDICTED_SPEED, STEP_SPEED, STEP_BIAS = 46, 49, 52, 55
NOISE, SD, RESTED, STRAYED, STARTED, FORCE = 58, 67, 70, 71, 72, 73
"""Diagonal of the step's noise (nine); deviation, rad; three flags; the integral of the specific force."""

STEP = 76

SAMPLE_TURN, SAMPLE_S, SAMPLE = 0, 4, 5
"""Of a sample within its step: start of the increment from the sample, xyzw, and its time since the start."""

# -- buffer: rows of SIZE numbers

SHOWS, CROSS, GAIN, WIDE, TRANSITION, NOISES, RESIDUAL, INNOVATION = 0, 3, 6, 9, 22, 35, 48, 49
FOUND, VECTOR, TURNS, FIT, MEAN_TURN, SYSTEM, RIGHT = 52, 53, 54, 55, 56, 59, 62
WORK = 65
"""Derivatives of an observation, its covariance with the state, its gain; a matrix to be filled; transition
and noise of the step; residual, and the observation's covariance. What is found of a reading; a vector and a
rotation; a fit of room and iron, its mean rotation and its equations. Kernels allocate nothing: each size of
a new array would be compiled anew."""
