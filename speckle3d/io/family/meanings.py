"""Units and meaning of our files' data sets, written into them as attributes `units` and `meaning`."""

from __future__ import annotations

import fnmatch

import h5py
import numpy as np

MEANINGS = {
    "rf": "1: echoes before demodulation, (frame, vector, sample)",
    "iq": "1: echoes after demodulation, I + iQ, (frame, vector, sample)",
    "bmode": "1: grey levels, (frame, column, row)",
    "frame_time_s": "s: time of each frame, strictly increasing",
    "*/time_s": "s: time of each reading on the sensor's clock; add time_offset_s for image time",
    "orientation/quaternion_wxyz": "1: world_from_sensor, unit quaternions, scalar first",
    "orientation/accelerometer_m_s2": "m/s^2: specific force along the sensor's axes",
    "orientation/gyroscope_rad_s": "rad/s: turn rate about the sensor's axes",
    "orientation/magnetometer_au": "arbitrary: magnetic field along the sensor's axes",
    "tracker/world_from_sensor": "mm: rigid matrices, sensor coordinates to the tracker's world",
    "tracker/valid": "1: whether a reading may be used",
    "truth/world_from_image": "mm: true rigid matrices, image coordinates (x lateral, y axial) to the world",
    "depth_mm": "mm: depth of each curve below the probe's face",
    "distance_mm": "mm: elevational distance of two frames",
    "correlation": "1: correlation of fully developed speckle, (depth, distance)",
    "cells": "1: independent speckle cells in a patch, per depth",
    "speckle/axial_mm": "mm: size of the phantom's speckle along the beam, per depth",
    "speckle/lateral_mm": "mm: size of the phantom's speckle across the beam, per depth",
    "tilt/pivot_mm": "mm: depth that tilted frames seem to turn about, per depth",
    "tilt/spread_mm": "mm: distance that tilt adds, per depth",
    "sensor_from_image": "mm: rigid matrix, image coordinates (x lateral, y axial) to the sensor's",
    "sensor_from_image_wxyz": "1: image axes to sensor axes, unit quaternion, scalar first",
    "pixel_mm": "mm: distance between columns and between rows",
    "covariance": "rad and mm: of tilt, yaw, roll, then x, y, z of the image in its own frame",
    "parameters/name": ": name of each parameter, as in its report",
    "parameters/value": "as in parameters/unit: estimate of each parameter",
    "parameters/standard_error": "as in parameters/unit: standard error of each parameter",
    "parameters/unit": ": unit of each parameter",
    "frames/used": "1: indices of the frames that were used, from 0",
    "frames/dropped": "1: indices of the frames that were left out, from 0",
    "frames/reason": ": why each of these was left out",
    "config_toml": ": every setting of the run, as TOML",
    "frame_flags": "1: bits of what was found wrong with each frame; 0: nothing",
    "poses/*": "mm: rigid matrices, image coordinates (x lateral, y axial) to the mode's world",
    "pose_covariance/*": "mm and rad: of each frame's x, y, z, tilt, yaw, roll about the image's centre",
    "pairs/first": "1: index of the earlier frame of each pair, from 0",
    "pairs/second": "1: index of the later frame of each pair, from 0",
    "pairs/first_from_second": "mm: rigid matrices, the later image's coordinates to the earlier's",
    "pairs/covariance": "mm and rad: of x, y, z, tilt, yaw, roll of each pair, at the image's centre",
    "pairs/patch_centre_mm": "mm: lateral and axial place of each patch in the image",
    "pairs/distance_mm": "mm: unsigned elevational distance of each patch of each pair",
    "pairs/sigma_mm": "mm: standard deviation of these distances",
    "pairs/used": "1: whether a patch took part in its pair's pose",
    "*settings_json": ": settings that the recording was read with, as JSON",
}
"""By patterns of data sets' names: their unit and, behind a colon, what they hold."""


def label(file: h5py.File) -> None:
    """Give every data set of a file of the family its attributes `units` and `meaning`."""
    names = list[str]()
    file.visit(names.append)
    for pattern, words in MEANINGS.items():
        for name in fnmatch.filter(names, pattern):
            attributes = file[name].attrs
            # Of fixed length: HDF5 never returns from zeros among texts of variable length.
            attributes["units"], _, attributes["meaning"] = map(np.bytes_, words.encode().partition(b": "))
