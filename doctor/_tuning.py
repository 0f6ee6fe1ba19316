"""Tuned numbers of listening and of guesses, with units and what sets them; ``python -m tests.formats`` judges them.

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

LIST = 4
"""numbers from which on the longest list in a line is that of the cells; among fewer the last one is"""
MOST_IDLE = 4
"""different lines that a board repeats while it waits"""
ASKED_AGAIN = 15
"""times that a board which answers is asked again"""
OTHERS_TRIED, MOST_OTHERS = 4, 3
"""guesses that are tried besides one that explains enough, and that are shown"""
BINS = 16
"""of the distributions of the halves of words"""
USUAL_BITS = 12
"""of a converter whose largest count has not been seen: too many bits cost nothing while no circuit is known"""

# Times, in s.
LISTEN_S, LONGEST_LISTENING_S = 1.5, 6.0
"""how long to listen at one baud rate before the bytes are judged: the slowest family sends two frames in a second; and
if bytes come that are no frames yet: a board boots, or sends slowly"""
ASKED = 5
"""that part of it which a board has to answer, and for which a further baud rate is heard if the port was silent"""
STILL_ALIVE = 0.5
"""share of the time after which a board stops that hears nothing: so often the start is sent again"""
QUIET_S, ANSWERED_S = 0.7, 0.1
"""without a byte, from which on a board counts as silent: a boot message may have come before; and an answer as over"""
PROGRESS_S = 0.25
"""between two words on what is being done"""
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
