"""The tuned numbers of the guesses, with their units and what sets them; ``python -m tests.formats`` judges them.

The formats of 54 public sketches, sent in bursts and over a UART, are the sample: none may be drafted wrong.
"""

from __future__ import annotations

# Shares of the cases, by how much an exception costs.
USUAL = 0.8
"""makes a rule: noise, boot messages and pauses of the operating system are the rest; a ratio of differences from which
on they are alike"""
PROVEN = 0.95
"""makes a rule of what lines or packets say themselves: a place, a length between delimiters"""
SURE = 0.995
"""of the bytes after the first frame in frames: a format taken for right, that more bytes could hardly change"""
GOOD_ACCOUNTED = 0.97
"""likewise, from which on no further guess is tried"""
DOUBTFUL = 0.9
"""likewise, below which the draft asks what the other bytes are"""
LEAST_ACCOUNTED = 0.5
"""likewise, from which on a guess is taken at all: boot messages come ahead"""
AS_GOOD = 0.02
"""more that a later guess must explain to be taken"""
TEXT_SHARE = 0.9
"""of printable characters, from which on a stream is text"""
COVERED = 0.6
"""of the stream that the returns of two bytes after one length make up, if these are a header"""

# Counts, by chance coincidences among them.
FEWEST = 3
"""frames, lines or documents that make a kind"""
FEWEST_FRAMES = 2
"""that a decoder must find: the slowest board sends two while it is listened to"""
MANY_FRAMES = 10
"""that are enough"""
SEVERAL = 5
"""returns of a header, steps of a number that rises, runs of equal frames: fewer look like one by chance"""

# Times, in s.
PAUSE_S = 0.003
"""least pause between two frames: several times what an operating system delays bytes by"""
PAUSES_APART = 2.0
"""ratio of a pause between frames to the time between pieces of one frame"""
CLOCKS_DIFFER = 0.2
"""share by which a board's time may differ from the host's, which arrival blurs"""
EVEN_STEPS = 0.5
"""share by which the steps of a time may differ from the median one"""

# Differences between numbers, relative.
HALF = 0.05
"""scatter of every other number over that of the rest, below which they are halves of longer words"""
HALVES_ALIKE = 0.4
"""sum of the differences of two distributions, below which they are the same; of few numbers chance adds to it"""

# Logarithms of likelihood, of base ten about.
PROOF = 20.0
"""that a right checksum adds; one of a single byte half of it"""
LEFT_OVER = 6.0
"""that a constant byte other than zero takes away where it would be a cell's"""
