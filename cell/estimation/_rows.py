"""Row numbers of two arrays: the memory of an inversion (rows common to all of them), and the readings of a frame."""

PRESSURE, GAIN, VARIANCE = range(3)
"""first rows of every memory: pressure in kPa; its gain in kPa per unit of r, by which noise enters; and its variance
in kPa^2 by the uncertainty of the memory"""
SHARED = 6
"""the standard deviation follows from at most this many first rows"""
READING, NOISE, SMOOTHED, STD = range(4)
"""rows of readings: raw reading, its standard deviation, smoothed reading, and the standard deviation of the latter"""
