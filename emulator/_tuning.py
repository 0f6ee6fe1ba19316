"""Tuned numbers of the emulator, each with its unit and what sets it: how often it looks, and how exact it is.

What a scene may say is limited with its keys; sizes of buffers that a scene sets stand in ``_line_settings.py``.
"""

# -- how often a board in service looks (_run.py, _line.py, firmware/) -----------------------------------------------

PIECE = 4096
"""bytes that go through the port at a time: read of a host before the board lives on, so that a flood of commands
cannot hold it up; arrived at the host's end before they are written; on a USB converter when it stops the board; room
in the transmit buffer with which commands are answered"""
HOST_POLL_S, LONGEST_WAIT_S = 0.01, 0.1
"""between two looks whether a host has come (opening a pty wakes nobody), and between two in any case"""
SOON_S = 0.001
"""between two looks at bytes on a UART, or at a late frame that is being computed"""
TICKS_AT_ONCE = 64
"""ticks between two looks at the port, at most"""
TICK_S = 5e-3
"""of board time between two looks at what the program of a real board has sent"""
CELLS_PERIOD_S = 1e-3
"""between two updates of what presses on the skin of a real board's program; a frame takes one or more of them"""
WRITTEN_S, WRITTEN_BYTES = 1.0, 1 << 19
"""after which frames of the truth are written"""

# -- for how long it waits --------------------------------------------------------------------------------------------

LISTENER_S = 1.0
"""for which a host may say nothing before it is taken for one that only listens (fast clock); and for which a host
behind a line that loses packets is told that no frame follows"""
DEAF_S = 5.0
"""for which a TCP host may leave waiting bytes unread before another one that knocks takes its place"""
DRAIN_S = 60.0
"""at the end, for a host that has stopped reading; a driver that loses nothing reads again when half of its 256 frames
are converted, for which plain Python on a busy machine takes half a minute. A processor that says nothing for so long
has hung"""
MOST_BEHIND_S = 0.5
"""by which a board may be late before its time is let go (real clock)"""

# -- how exact it is --------------------------------------------------------------------------------------------------

BAUD_TOLERANCE = 0.04
"""relative error of the baud rate that a UART of 10 bits a byte stands: half a bit in ten, less its sampling error"""
REST_STEPS = 1.0 / 64.0
"""ADC steps at full scale by which a cell may still be off when it is taken to be at rest again"""
LONGEST_BLOCK, LONGEST_DENSE_BLOCK = 512, 8
"""frames that are computed together: longer blocks would not be cheaper; and where each frame takes a dense system of
all lines, which frames of a block do not share"""
BELL_REACH = 5.0
"""standard deviations, on each axis: a bell is below 4e-6 of its peak there and is cut off"""
SPREAD_REACH, SPREAD_POINTS = 4, 16
"""cells on each side that feel a load through a layer; Gauss-Legendre points along a cell's side"""
SAME_RESISTANCE = 1e-6
"""relative change of all cells below which the circuit is not solved again: far below a step of the ADC"""
PREDICTED_ACQUISITION_S = 2e-6
"""given to the predicted capacitor: Settling has all conversions of a row follow each other at its end"""
SHORT_OHM, SILENT_STEPS = 1000.0, 1.5
"""of the self-test: two lines joined by less are reported as shorted, far below any cell at rest; ADC steps around the
reading of an open cell within which no current is said to flow"""

# -- what a score calls a contact (_score.py) -------------------------------------------------------------------------

CONTACT_SHARE, REST_SHARE = 0.1, 0.01
"""of full scale: a contact is a patch of cells above the one, and a cell that bears at most the other is at rest"""
PAIR_CELLS = 3.0
"""distance from which on contacts are not the same: one is missed, the other false"""
LARGEST_PACE = 2.0
"""ratio of the times that host and board take for the same frames, up to which the board ran in real time"""
LONGEST_DELAY_S = 2.0
"""by which a recording may follow the truth"""
