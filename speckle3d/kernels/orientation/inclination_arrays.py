"""Places of numbers in the arrays of the orientation filter.

Its kernels pass one array for the state, one row for a step and one for the limits: an array in a compiled
call is a dozen values, and a tuple of arrays as many for each, which took minutes to compile.
"""

SIZE = 9
"""Attitude (world axes), gyroscope bias (sensor axes) and velocity (world axes)."""

# -- limits: constants of the filter, and those of the settings that it uses

GRAVITY, GYRO_NOISE, GYRO_SCALE_NOISE, BIAS_WALK, SPEED_VARIANCE, REST_SPEED_VARIANCE = 0, 1, 2, 3, 4, 5
FORCE_NOISE, REST_NOISE, REST_BIAS_VARIANCE, FIRST_S = 6, 7, 8, 9
STILL_RATE, STILL_FORCE, STILL_S, STILL_BIAS, REST_MEMORY_S, HEADING_APART = 10, 11, 12, 13, 14, 15
FIRST_MOVING_S, LONGEST_S = 16, 17
"""SI units; `LONGEST_S`: the longest step without lost samples; `HEADING_APART`: one if corrections leave the
heading alone, which is found elsewhere."""

LIMITS = 18

# -- state of the filter, kept from one stretch to the next

RUNNING, STARTING, RESTING, SPEED, BIAS = 0, 1, 2, 3, 6
REST_KNOWN, REST_RATE, REST_FORCE, STILL = 9, 10, 13, 16
START_S, START_FORCE = 17, 18
"""Flags, velocity, bias; rest detector; the start's mean."""

LEVEL, START_TURN, LAST_RATE = 21, 30, 39
"""World from sensor; a start's first axes from the present ones; the gyroscope's last reading."""

STATE = 42

# -- a step: one increment, and the filter before and after it

DURATION, RATE, FIELD, ASSUMED, TURN = 0, 1, 4, 7, 10
"""s; mean gyroscope; mean field, NaN where there is none; the bias with which turns were summed; start from
end of the increment (nine)."""

STEP_START, PREDICTED, MATRIX = 19, 28, 37
"""World from sensor before the increment, after it, and after its correction (nine)."""

STEP_START_BIAS, PREDICTED_SPEED, STEP_SPEED, STEP_BIAS = 46, 49, 52, 55
NOISE, DEVIATION, RESTED, STARTED, FORCE, BRIDGED = 58, 67, 73, 74, 75, 78
"""Diagonal of the step's noise (nine); standard deviations of attitude and bias (six), rad and rad/s; two
flags; the integral of the specific force; variance of the turn over lost samples."""

STEP = 79

SAMPLE_S, SAMPLE = 4, 5
"""Of a sample within its step: start of the increment from it, xyzw, then its time since the start."""

# -- buffer: rows of SIZE numbers

SHOWS, CROSS, GAIN, WIDE, TRANSITION, NOISES, RESIDUAL, INNOVATION = 0, 3, 6, 9, 18, 27, 36, 37
VECTOR, TURNS = 40, 41
WORK = 42
"""Derivatives of an observation, its covariance with the state, its gain; a matrix to be filled; transition
and noise of the step; residual, and the observation's covariance; a vector and a rotation. Kernels allocate
nothing: each size of a new array would be compiled anew."""
