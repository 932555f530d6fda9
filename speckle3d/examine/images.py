"""Check a sweep's images: one probe that moves past the tissue, with the stated signal.

Each test asks for what no honest sweep shows, however noisy, and needs no truth: frames far apart that hold
the same echoes in the same place, frames that resemble the one before less than the one before that, pairs
that are equally alike and not equally far apart, and a length that the images leave open.
"""

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import PROBE_SIGMA, DecorrelationCurves
from speckle3d.core.errors import Doubt, InsufficientDataError, MismatchError
from speckle3d.core.poses import HELD
from speckle3d.core.sweep import RFSettings
from speckle3d.examine.curves import examine_curves, require_usable
from speckle3d.examine.disagreements import JOINT_CLAIMS
from speckle3d.examine.sensors import REFUTED, runs_of
from speckle3d.matching.frames import MatchedSweep
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import Texture
from speckle3d.motion.estimate import Motion
from speckle3d.motion.planes import LEAST_CORRELATION

IMAGES = "images"
"""What all doubts of this module are about."""

OPEN_SHARE = 0.25
"""Standard error over length from which a length is flagged. Good sweeps
claim up to 0.06, those with noise of half the signal's power 0.15."""

SPECKLE_DB = 5.57
"""Standard deviation of speckle's decibels. With eight grey levels of 60 dB, 8.6 dB apart, simulated lengths
are 27 % short to 56 % long, at 2.5 of their claims; with sixteen 7 to 19 % long, at 1.4."""
NOISE_QUANTILE, LEAST_ECHO = 0.2, 0.05
"""Of the spectrum's power, what is noise at all frequencies; and the share that is echo at least."""

ECHO_LIMITS = 0.01, 0.15
"""Share of the power from which clutter is told, by the mean patch, and refused, by the median one. Simulated
phantoms read 4 % long at 0.006, 8 % at 0.025, six standard errors wrong at 0.09; clutter of 4 % of the power
reads as 0.025, none as up to 0.004. In a quarter of the patches it is made good by the adaptation to coherent
echoes, in half not."""
INTENSITY_LIMITS = 0.1, 0.25
"""The same by the median patch for images without phase, where layers along the sweep stand still, too: bone
and spine have 0.01 to 0.05. A quarter of the intensity's variation is half of the echo's power."""

OUT_OF_TURN = 0.1
"""By how much a frame must be less like the last one than like an earlier one: ten times what the median
over fifty patches scatters by. At 0 sweeps at rest are refused; half and twice as much change nothing."""
MOST_OUT_OF_TURN = 0.6
"""Share of such frames. A wobble of 3 Hz at 25 frames a second has a quarter of them, at its turns. Half and
half as much again change nothing, of thirty-two made motions."""

LARGEST_AVERAGING = 0.03
"""Of the length, from which averaging refuses it: the share is known to a factor of two."""

LEAST_ALIKE = 0.2
"""Median correlation from which distances are compared: less hides in what stays. Where speckle ends, at
0.03, honest fast sweeps are doubted."""
WINDOW = 8
"""Frames over which distances are compared with what pairs as alike have elsewhere: a fold of the path takes
no more. A quarter of a window on comes the next."""
LEAST_PAIRS = 6
"""Pairs that a window, and patches that an image needs: medians over fewer scatter too much."""
FOLD_DOUBT = 0.2
"""Mean departure over mean distance in the worst window. Of 64 small sweeps of 6 to 21 patches, those right
to three standard errors have up to 0.18, two at three of them 0.23 and 0.24, and three that are a quarter to
a half too short 0.41 and more; whole images have up to 0.05, with noise of a tenth of the power 0.14."""


def examine_echoes(matches: MatchedSweep) -> tuple[Doubt, ...]:
    """Check a sweep's samples against the stated band and sampling rate.

    Raises
    ------
    MismatchError
        If the echoes are not of that band, or grey levels too few.
    """
    texture = matches.texture
    return require_usable((doubt_band(texture), doubt_steps(texture)), MismatchError)


def doubt_band(texture: Texture) -> Doubt | None:
    """Refute a sampling rate or a band that the echoes contradict.

    Tissue takes high frequencies away and adds none, so most of the echo above the noise cannot lie above the
    band; below it lies what attenuation or a harmonic leaves, which is no contradiction.
    """
    signal = texture.signal
    if not isinstance(signal, RFSettings):
        return None
    power = np.mean([look.sampled for look in texture.looks.values()], axis=0)
    low, high = signal.bandwidth_hz
    frequency = signal.bin_frequency_hz(power.size)
    rising = np.argsort(frequency)
    # Mains, gain control and steps between samples are below.
    rising = rising[frequency[rising] >= low / 4]
    frequency, power = frequency[rising], power[rising]
    echo = np.maximum(power - 2 * np.quantile(power, NOISE_QUANTILE), 0.0)
    if echo.sum() <= LEAST_ECHO * power.sum():
        return None
    middle = float(np.interp(0.5, np.cumsum(echo) / echo.sum(), frequency))
    if middle <= high:
        return None
    evidence = (
        f"expected echoes of {low / 1e6:.3g} to {high / 1e6:.3g} MHz, got half of their power above "
        f"{middle / 1e6:.3g} MHz"
    )
    return Doubt(IMAGES, "sampling rate or band", evidence, True)


def doubt_steps(texture: Texture) -> Doubt | None:
    """Refute images whose neighbouring grey levels are farther apart than speckle varies."""
    signal = texture.signal
    if isinstance(signal, RFSettings):
        return None
    step = np.median([look.step for look in texture.looks.values()])
    step_db = float(step / signal.full_scale * signal.dynamic_range_db)
    if step_db <= SPECKLE_DB:
        return None
    evidence = f"expected grey levels at most {SPECKLE_DB:g} dB apart, got {step_db:.1f} dB"
    return Doubt(IMAGES, "images of few grey levels", evidence, True)


def examine_processing(grey: float, short: float) -> tuple[Doubt, ...]:
    """Report grey levels that are not the logarithm of speckle, and averaged frames.

    Parameters
    ----------
    grey : float
        Relative standard deviation of lengths by grey levels that are not speckle's.
    short : float
        Share of the length that averaging of frames takes.

    Raises
    ------
    InsufficientDataError
        If averaging takes too much.
    """
    doubts = []
    if short > 0.0:
        evidence = (
            "expected grey levels that vary as much at speed as at rest, got frames that are means of "
            f"several (persistence, frame averaging): lengths come out some {short:.0%} short"
        )
        doubts.append(Doubt(IMAGES, "averaged frames", evidence, short > LARGEST_AVERAGING))
    if grey > PROBE_SIGMA:
        evidence = (
            "expected grey levels that vary as speckle's decibels, got those of structure, edge enhancement, "
            f"smoothing or another map: lengths are open by {grey:.0%}; curves of a tracked sweep know it"
        )
        doubts.append(Doubt(IMAGES, "filtered images", evidence, False))
    return require_usable(doubts, InsufficientDataError)


def examine_images(
    matches: MatchedSweep,
    motion: Motion,
    covariance: FloatArray,
    curves: DecorrelationCurves,
    usable: BoolArray,
) -> tuple[Doubt, ...]:
    """Check a sweep's images against the motion and the curves.

    Parameters
    ----------
    covariance : ndarray, shape (n, 6, 6)
        Claimed for its poses.
    curves : DecorrelationCurves
        As measured, but stretched for structure where that is seen in place of speckle.
    usable : ndarray of bool, shape (n,)

    Raises
    ------
    MismatchError
        If the curves are refuted.
    InsufficientDataError
        If so much stands still that distances mean nothing, the images do not determine the length, or they
        cannot be those of one probe that moves.
    """
    pairs, problem, texture, z_mm = motion.pairs, motion.problem, matches.texture, motion.path[:, 0]
    inside, frames = problem.patches.inside, np.array(list(texture.looks))
    far = far_apart(z_mm, frames[usable[frames]], curves)
    share = standing_share(texture, far) if len(far) else np.full(inside.size, np.nan)
    share[~inside | (matches.echoless > 0.5)] = np.nan
    images = (
        doubt_shadow(matches.echoless[inside]),
        doubt_order(matches.table, problem.frames, problem.trajectory.least_correlation),
        doubt_clutter(share, len(far), float(np.median(curves.cells)), problem.at_patches.of_echo),
    )
    path = (
        doubt_length(z_mm, np.sqrt(covariance[:, 2, 2]), float(curves.distance_mm[-1])),
        doubt_connection(pairs.first, pairs.second, usable),
        doubt_path(matches.table, motion.poses, problem.patches.centre_mm, usable),
    )
    return (
        *require_usable(images, InsufficientDataError),
        *require_usable(examine_curves(texture, motion), MismatchError),
        *require_usable(path, InsufficientDataError),
    )


def doubt_shadow(echoless: FloatArray) -> Doubt | None:
    """Report a patch or more without an echo, which are left out.

    Parameters
    ----------
    echoless : ndarray, shape (p,)
        Share of the frames in which each patch of the region was.
    """
    share = float(echoless.mean())
    if share * echoless.size < 1.0:
        return None
    evidence = (
        f"expected echoes all over the image, got none in {share:.0%} of it (shadow, noise, lost contact, or "
        "text on the image), which is left out"
    )
    return Doubt(IMAGES, "", evidence, False)


def doubt_length(position_mm: FloatArray, sigma_mm: FloatArray, reach_mm: float) -> Doubt | None:
    """Doubt a length whose standard error is a large part of itself and of what the curves measure.

    Parameters
    ----------
    position_mm, sigma_mm : ndarray, shape (n,)
        Elevational position of every frame, and its standard deviation against the first.
    reach_mm : float
        Largest distance in the curves: a probe at rest is known to much less.
    """
    length, sigma = float(np.ptp(position_mm)), float(np.max(sigma_mm))
    limit = max(OPEN_SHARE * length, reach_mm / 2)
    if sigma <= limit:
        return None
    evidence = (
        f"expected a length known to {limit:.3g} mm, got {length:.3g} mm with a standard error of "
        f"{sigma:.3g} mm: the correlations do not determine it"
    )
    return Doubt(IMAGES, "too little speckle in common", evidence, sigma > REFUTED * limit)


def doubt_order(table: CorrelationTable, frames: int, least_correlation: float) -> Doubt | None:
    """Doubt a sweep whose frames resemble earlier ones more than the last: not recorded in this order."""
    last, before = np.full((2, frames), -1.0)
    lag = table.second - table.first
    for best, rows in ((last, lag == 1), (before, lag > 1)):
        np.maximum.at(best, table.second[rows], table.median[rows])
    whole = (np.minimum(last, before) >= 0.0) & ~table.unmatched(frames, least_correlation)
    share = float(np.mean(before[whole] > last[whole] + OUT_OF_TURN)) if whole.sum() > 3 else 0.0
    if share <= MOST_OUT_OF_TURN:
        return None
    evidence = (
        f"expected frames most like the one just before, got {share:.0%} of them ({int(whole.sum())}) more "
        "like earlier ones"
    )
    return Doubt(IMAGES, "sweeps interleaved, or frames out of order", evidence, True)


def far_apart(position_mm: FloatArray, frames: IntArray, curves: DecorrelationCurves) -> IntArray:
    """Pairs of some frames that are beyond the reach of speckle, shape (m, 2).

    Parameters
    ----------
    position_mm : ndarray, shape (n,)
        Of all frames.
    """
    left = np.median(curves.correlation, axis=0)
    apart_mm = float(curves.distance_mm[np.argmax(left <= max(LEAST_CORRELATION, left[-1]))])
    pairs = frames[np.column_stack(np.triu_indices(frames.size, 1))]
    return np.asarray(pairs[np.abs(np.diff(position_mm[pairs], axis=1))[:, 0] >= apart_mm])


def standing_share(texture: Texture, pairs: IntArray) -> FloatArray:
    """Share of each patch's power that is the same in all frames: median over pairs of them, shape (p,).

    Echoes that stay where they are while the probe moves are reverberation, side lobes, electronics.
    Speckle of places a beam's width and more apart has nothing in common, so that the product of two such
    frames' echoes, sample by sample and without looking for in-plane motion, averages to zero. What is
    added to every frame alike does not: the product's mean is its share of the power. The tissue's own
    structure moves in the image as the hand wanders, and a quarter of a wavelength in depth turns its
    phase round.

    Parameters
    ----------
    pairs : ndarray of int, shape (m, 2)
        Of frames looked at, far apart. The median lets some see what others do, as on the way back.

    Returns
    -------
    ndarray, shape (p,)
        Of power, or with images of intensity of its variation; of either sign and about zero where
        nothing stays. NaN where there is no echo.
    """
    frames, at = np.unique(pairs, return_inverse=True)
    echoes = np.stack([texture.looks[k].echo for k in frames.tolist()], axis=1)
    common = echoes @ echoes.transpose(0, 2, 1)
    return np.asarray(np.median(common[:, *at.reshape(-1, 2).T], axis=1), dtype=float)


def doubt_clutter(share: FloatArray, pairs: int, cells: float, of_echo: bool = True) -> Doubt | None:
    """Doubt images with static echoes in frames far apart.

    Parameters
    ----------
    share : ndarray, shape (p,)
        Of each patch's power, from `standing_share`.
    pairs : int
        Of frames, from which it was measured.
    cells : float
        Independent speckle cells in a patch.
    of_echo : bool
        Whether the images have phase.
    """
    shares = share[np.isfinite(share)]
    if not shares.size:
        return None
    # Each pair's coherence scatters by one over the root of twice its cells; pairs that share a frame are
    # nearly independent, and medians, of pairs and of patches, scatter by a quarter more than means.
    chance = JOINT_CLAIMS * 1.25**2 / np.sqrt(2.0 * cells * pairs * shares.size)
    least, most = ECHO_LIMITS if of_echo else INTENSITY_LIMITS
    median = float(np.median(shares))
    typical = float(np.mean(shares)) if of_echo else median
    if typical <= max(least, chance):
        return None
    evidence = (
        f"expected nothing in common between frames beyond speckle's reach, got {typical:.1%} of the echo's "
        "power the same at the same place"
    )
    suspect = "static clutter, or noise on a probe at rest"
    return Doubt(IMAGES, suspect, evidence, median > max(most, chance))


def doubt_path(
    table: CorrelationTable, poses: RigidTransform, patch_centre_mm: FloatArray, usable: BoolArray
) -> Doubt | None:
    """Doubt a path on which pairs that are equally alike are not equally far apart.

    Whatever noise and structure do to correlations, they fall as frames move apart. The distance that goes
    with each correlation is found from the sweep itself, by isotonic regression; where the path takes a wrong
    turn and folds back on itself, distances fall short of it.

    Parameters
    ----------
    poses : RigidTransform, length n
    patch_centre_mm : ndarray, shape (p, 2)
        In the image.
    usable : ndarray of bool, shape (n,)
    """
    rows = np.flatnonzero((table.median > LEAST_ALIKE) & table.joins(usable))
    rows = rows[np.argsort(-table.median[rows], kind="stable")]
    if rows.size < LEAST_PAIRS or len(patch_centre_mm) < LEAST_PAIRS:
        return None
    second = table.second[rows]
    # Median elevational distance of the patches between the frames of each pair.
    centres = np.column_stack([patch_centre_mm, np.zeros(len(patch_centre_mm))])
    matrix = (poses[table.first[rows]].inv() * poses[second]).as_matrix()
    apart = np.median(np.abs(matrix[:, 2, :3] @ centres.T + matrix[:, 2, 3:]), axis=1)
    expected = np.asarray(isotonic_regression(apart).x)
    worst, at = 0.0, 0
    for start in range(0, len(poses), WINDOW // 4):
        inside = (second >= start) & (second < start + WINDOW)
        if inside.sum() >= LEAST_PAIRS:
            # Where the probe rests there is no distance to compare with.
            typical = max(float(expected[inside].mean()), float(expected.mean()) / 4, 1e-9)
            departure = float(np.abs(apart - expected)[inside].mean()) / typical
            worst, at = max((worst, at), (departure, start))
    if worst <= FOLD_DOUBT:
        return None
    evidence = (
        f"expected frames equally alike to be equally far apart, got distances {worst:.0%} off what the "
        f"sweep's other pairs have, about frame {at + WINDOW // 2}"
    )
    where = (at, min(at + WINDOW, len(poses)) - 1)
    return Doubt(IMAGES, "direction lost, noise or clutter", evidence, worst > REFUTED * FOLD_DOUBT, (where,))


def doubt_connection(first: IntArray, second: IntArray, usable: BoolArray) -> Doubt | None:
    """Doubt a sweep in pieces: frames that no pair joins to any before them, though both sides are sound.

    Parameters
    ----------
    first, second : ndarray of int, shape (e,)
        Frames of the pairs that the trajectory was solved from.
    usable : ndarray of bool, shape (n,)
    """
    connection, sound = np.zeros(usable.size, dtype=bool), np.flatnonzero(usable)
    for begin, end in zip(first.tolist(), second.tolist(), strict=True):
        connection[begin + 1 : end + 1] = True
    connection[: sound[0] + 1] = connection[sound[-1] + 1 :] = True
    # Lost frames are open on both sides; one cut at each run of them.
    cuts = [begin for begin, _ in runs_of(np.flatnonzero(~connection))]
    if not cuts:
        return None
    evidence = (
        f"expected speckle that joins all frames, got none at {len(cuts)} places, the first across frame "
        f"{cuts[0]}: what was travelled there is a guess within {HELD[2]:g} mm"
    )
    where = tuple((k, k) for k in cuts)
    return Doubt(IMAGES, "too fast, lifted, or frames lost", evidence, False, where)
