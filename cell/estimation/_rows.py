"""The rows of an inversion's memory that every inversion has, and those of the readings of a frame."""

PRESSURE, GAIN, VARIANCE = range(3)
"""first rows of every memory: kPa; kPa per unit of r by which noise enters it; kPa^2 by which memory adds to it"""
SHARED = 6
"""number of first rows, at most, that the standard deviation follows from"""
READING, NOISE, SMOOTHED, STD = range(4)
"""rows of readings: as they are, and their standard deviation; smoothed, and the standard deviation of that"""
