"""Tuned numbers of the driver, each with its unit and what sets it. What follows from others is computed at its use.

Limits of inputs, formats and units stand in the modules that read or write them.
"""

from __future__ import annotations

# -- levels of noise, in standard deviations ---------------------------------------------------------------------------

SURE_STDS = 5.0
"""that noise does not reach among thousands of cells and frames: a contact begins, fingers part, a resistance changes
during a tare, a line is faulty. A contact goes on, or takes in a cell, from half of it on"""
HELD_STDS = 0.5
"""from which on a cell stays in a contact"""
TOGETHER_STDS = 2.0
"""a contact also begins where the mean of neighbouring cells, weighted like a fingertip, exceeds this many times the
mean of their standard deviations. Neighbours share their history, so their errors are taken for common ones. The mean
without the cell's row, and without its column, must exceed it, too: faults of wires and converters move one line"""
STANDS_OUT_STDS = 8.0
"""of a new patch that electrical faults may have made, above which it is a contact if it rose over several frames"""
OUTLYING_STDS = 4.0
"""a cell this far from the others, in robust standard deviations of all, is an outlier of their scatter"""
SPREADS = 3.0
"""of unknown rest resistances, and of readings that are to agree"""
STEPS = 2.0
"""standard deviations by ADC steps that no reading errs by: a rounding error is at most the square root of 3 of them"""
GUARD_STDS = 6.0
"""guard band: within it an output may stand at a limit of its swing"""

# -- times of the link, s ----------------------------------------------------------------------------------------------

GONE_S = 3.0
"""a peer that gives no sign for this long is gone: a TCP connection without an acknowledgement (a cable pulled at its
end gives no other sign), a board that does not prove after a reconnection that it is the same one. All frames later
than their clock's line for so long: the board's clock was set"""
ANSWER_S = 5.0
"""most time for an answer from outside: a TCP connection, a board that restarts whenever its port is opened"""
SEARCH_S = 1.5
"""for which a silent port is asked at first"""
NEGOTIATION_S = 15.0
"""longest wait for an RFC 2217 server to agree on its options"""
ASK_AGAIN_S = 0.5
"""a board that sends nothing for this time is asked again; after half of it where it has not identified itself: a lossy
line needs several answers for a whole description"""
WRITE_TIMEOUT_S = 1.0
"""a line that takes no byte for this long is broken"""
URL_WAIT_S = 0.1
"""longest wait for a byte by pyserial's own method, which cannot be interrupted"""
FIRST_DELAY_S, LONGEST_DELAY_S = 0.1, 1.0
"""between attempts to open a lost port, which double"""
CLOSE_S = 2.0
"""how long closing waits for a thread that may be busy opening a port, or for a callback, which may itself be waiting
for the closing thread"""
RELEASE_S = 20.0
"""the same where the thread has a port, which the next to open it needs: a busy machine may keep it for seconds"""
POLL_S = 0.05
"""between looks at another thread: whether it has read, set up, or compiles"""
READ_AGAIN_S = 0.0005
"""a reader who has read and converted for longer reads again, since newer frames may have come meanwhile"""
LONGEST_TURN_S = 0.02
"""of processor time, after which a turn of reading ends, whatever came: readers wait for it, and so does closing"""
LONGEST_REST_S = 1.0
"""most time that the thread rests after such a turn; it rests for as long as the turn took"""
LATE_S = 0.01
"""of processor time that a reader of the newest frame spends on those before it. Those that are left then are skipped:
boards may send faster than a computer converts"""
MAX_AGE_S = 0.5
"""default of :meth:`.Skin.latest`: boards send at 10 Hz and more"""
FLUSH_S = 1.0
"""of a recording, after which a chunk is written: what is lost of one that is cut short"""
PATIENCE = 10.0
"""limit on the real time of a set-up that waits for the processor, over the limit on its processor time. When a robot's
computer boots, dozens of programs start at once"""

# -- amounts of the link -----------------------------------------------------------------------------------------------

QUEUE = 256
"""default number of frames that wait for readers; views without contacts that nobody holds, until they are forgotten"""
RECENT_FRAMES = 1000
"""over which statistics are computed; kept until a board has proved that it is the same one, or the disk is behind"""
REMEMBERED = 64
"""frames among which a duplicate is looked for, and by which a packet may be late; arrivals over which the usual
interval is computed; frames that are converted as one block"""
MANY = 128
"""packets after which a turn of reading ends; default of :meth:`.Skin.read_many`"""
CONVERTED_IN_TURN = 4
"""frames that the thread converts before it reads the port again, whose buffers hold some milliseconds"""
ANSWER_LIES_BEHIND = 8
"""queues of frames that may lie on the line before an answer"""
READ_BYTES = 8192
"""bytes of a read at most, so that one read is a small part of a turn, however fast a board sends"""
CHUNK_BYTES = 2**20
"""of a recording"""
MOST_ABANDONED = 2
"""set-ups that took too long and go on for nobody: each takes a thread, and up to hundreds of MB"""
TEXT_SHARE = 0.9
"""of printable characters, from which on bytes that are no packets are shown as text"""

# -- clocks and numbers of frames --------------------------------------------------------------------------------------

BUCKET_S = 0.25
"""s of the host; only the least delayed frame of each such interval is kept. A line is sloped from two of them on"""
DRIFT_SPAN_S = 5.0
"""span from which on the drift of a clock is reported"""
LARGEST_DRIFT = 0.125
"""on-chip RC oscillators are off by up to 10 %, a drift of 1 / 0.9 - 1; the rest is for the noise of delays"""
PACE_PAIRS = 4
"""intervals, one after the other, of which all but one (a pause) must be too long or too short for a clock"""
STEP_S = 0.05
"""lateness of all frames of :data:`GONE_S` beyond the clock's line, by which the clock was set or has paused"""
CLOCK_SET_S, CLOCK_SET_STEPS = 1.0, 100
"""the board's clock was set forward if it advances by so many s more than the host's, and by so many usual steps"""
FASTER = 10.0
"""largest ratio of a board's frame rate to its usual one that may explain a jump of the numbers"""
LEAST_PERIOD_US = 10.0
"""shortest time between two frames of any board"""
BUFFERED_S = 10.0
"""longest time for which the bytes of a board without a clock may have waited in buffers"""
FASTEST_CLOCK = 4.0
"""s in a second: a divider that was set wrongly; a time that goes faster is a simulation's or a recording's"""
LEAST_STEP_S = 1e-6
"""least step of time for the estimator, which needs increasing times"""
KEEP_STATE_S = 60.0
"""after a longer gap the estimator restarts: the loads during the gap are unknown. For so long the line of a clock
follows its frames, as its drift changes with temperature"""

# -- readings ----------------------------------------------------------------------------------------------------------

FIRST_GUARD = 12
"""codes, guard band at a limit of the swing in the first frame, whose noise is unknown"""
FINE_GUARD = 2.0**-14
"""of the range, likewise in two frames: the noise of converters of 18 to 24 bits is many codes"""
MEASURED = 3
"""number of the first frame in which noise of any size may be known"""
JUMP = 1.0 / 16.0
"""of the converter's codes, from one frame to the next: a larger change of a reading is a jump"""
ALIKE_NOISE = 1.5
"""ratio of noises up to which the judgement of a reading stays about the same"""
NEGLIGIBLE = 0.05
"""ADC steps of noise that are negligible beside the half step"""
ASSUMED = 0.5
"""ADC steps of noise before anything is measured"""
LEAST_SCALE = 0.1
"""least relative error of a column, by half a step of all other readings, that is removed"""
FINE_FOR = 15
"""frames for which a small error counts as small without being measured anew"""
ALIKE_SHARE = 0.8
"""least share of cells in a column that are alike at rest, by :data:`DRIFT`, and hence rounded alike"""
ALIKE_IN_STEPS = 2.0
"""by how much equal readings, rounded alike, exceed independent errors in what a measurement states of a column"""
SPEAKS = 3
"""1/SPEAKS of a column's cells lie below the cell that represents the column"""

# -- rest and tare -----------------------------------------------------------------------------------------------------

TARE_FRAMES = 20
"""of a usual tare. The estimator sees as many again with new rest resistances: they tell it that the skin is at rest,
or what lies on it"""
SPREAD = 0.3
"""default relative deviation of a cell from the other cells that manufacturing tolerances explain; the project's own
choice"""
SHEET_FACTOR = 2.0
"""factor between the typical cell and its data sheet that manufacturing tolerances explain"""
KNOWN_DRIFT = 0.1
"""relative change since an earlier tare or a calibration that temperature, age and earlier loads explain; the project's
own choice"""
DRIFT_PER_S = 0.003
"""relative change of a rest resistance per second: warming up takes minutes. A finger presses much faster"""
CONTACT_LOAD = 0.1
"""share of full scale that electrodes in light contact may seem to bear at rest, since glue and covers press on them"""
DRIFT = 0.01
"""relative change of a resistance during the tare that a resting cell may show; difference of cells that are equal"""
DRIFT_COUNTS = 2.0
"""change of a count, likewise"""
NOISE_SHARE = 0.5
"""share of the tolerated deviation for noise; the rest is for manufacturing tolerances"""
TYPICAL_READINGS = 4
"""weight of the noise of all cells in the noise of one cell, in readings of that cell"""
ENOUGH_READINGS = 8.0
"""readings of the usual noisy cell in a tare that covers nearly all: then one cell in 3000 has none (Poisson)"""
UPDATE_EVERY, UPDATE_AT = 8, 3
"""interval in frames between two measurements of the cells' spread, and the frame of each interval that has it.
Estimators look back at their readings in every fourth frame, from the first on; both in one frame would make it long"""
EXPLAINED = 0.95
"""share of cells within half an ADC step of the data sheet from which on the spread counts as zero; largest relative
error of a conductance by half a step that counts"""
FIRST_FRAMES, UNSETTLED_FRAMES = 50, 10
"""by which the driver judges board and skin, and the first of these, in which the noise is hardly known"""
FEW_VALID = 0.02
"""fraction of valid cells in those frames below which the driver reports the reason"""
CLEAR_SHARE = 0.01
"""fraction of full scale: pressure error by unknown rest resistances from which on the driver reports them"""

# -- lines that are cracked or bridged ---------------------------------------------------------------------------------

EVERY_S = 0.08
"""s from one update of the lines to the next"""
LONGEST_GAP_S = 1.0
"""s without a frame, after which no change is known to be sudden"""
LEAST_CELLS = 4
"""of a line that must move together, as fewer may be a fingertip; of a skin whose spread is measured"""
LEAST_CHANGE = 0.03
"""least change of a resistance (natural logarithm) that is examined"""
SHARE_OF_CELLS = 0.75
"""share of a line's cells that must agree; the others may be pressed or released meanwhile"""
ASIDE = 0.25
"""fraction of a line's change. The rest of the board must have moved by less; a faulty line whose change has come down
to less is sound again"""
UNEQUAL = 0.03
"""fraction of a change by which the cells of a cracked line may differ, beside noise: their columns load them
differently"""
BELOW_REST = 0.2
"""margin (natural logarithm) below rest and below all that a cell has read, where no load takes it. Ageing is slower"""
FIRST_VERDICT_S, LAST_VERDICT_S = 1.0, 8.0
"""time after the change of a line in which creep is compared"""
LEAST_CREEP = 0.002
"""error of the creep model, root mean square, relative to the change: smaller differences decide nothing"""
RESTED = 0.1
"""relative to the change: cells at most this far above their least reading creep like cells at rest"""
CREEP_KEPT = 1.0 / 3.0
"""least creep of a load over that of the model; the largest is the inverse"""
ONSET_S = 0.5
"""s by which a load may have begun before its change was seen, or for which it may have come on"""
FITS = 2.0
"""largest mean square of what a crack leaves unexplained, over the variance of the noise"""
OVERLOAD = 4.0
"""change of a resistance over the change at full scale, which no press on a whole line exceeds"""

# -- contacts ----------------------------------------------------------------------------------------------------------

ABSENT_S = 0.2
"""for which the last known counts: the reading of a cell, the frame of one of several boards, the id of a contact"""
START_SHARE, JOIN_SHARE = 0.03, 0.0192
"""of full scale, which a cell exceeds that begins a contact, or joins one; half of the first where it stays: the
standard deviation leaves out slow errors of the cell model"""
RIM_SHARE = 0.005
"""fraction of full scale, down to which the force of cells around a contact counts as its own"""
WAKE_SHARE, WAKE_S = 0.15, 1.0
"""fraction of the largest pressure in a cell and those near it, forgotten with this time constant: what a finger
leaves in the estimates behind it and beside it is less, and is no contact"""
INTERMITTENT_S = 0.1
"""a new patch within one row or column may be a disturbance of the converter: it is a contact in its second frame. One
that electrical faults may have made (:func:`._patches.may_be_fault`) is one after this time, unless it stands out
(:data:`STANDS_OUT_STDS`): a fault comes and goes at once"""
AT_ONCE, ALIKE = 0.5, 0.5
"""share of a pressure that comes with one frame in a jump; least pressure in faulty lines over their largest"""
LONGEST_IN_LINE = 3
"""cells within one line that a stylus covers"""
BESIDE = 0.5
"""weight of the cells beside a cell under a fingertip, whose own is 1; squared, of those at its corners"""
PART_SHARE = 0.3
"""depth of a saddle below the lower maximum, relative to it, at which two fingers part: one finger is less uneven. Half
of it, and of the standard deviations (:data:`SURE_STDS`), at which they stay parted"""
BETWEEN_PITCHES = 3.0
"""distance of boards whose places nobody has given, in pitches: contacts do not go across"""
SPEED_MM_PER_S, REACH_PITCHES = 500.0, 1.5
"""largest distance of a contact from its last position, or from its predicted one: the speed times the time since then,
and so many pitches"""
MEMORY_S = 0.05
"""time constant of the g-h filter for position and velocity: fingers turn more slowly, and noise is averaged"""
LEAST_SHARE, SURE_SHARE = 0.1, 0.35
"""fraction of a patch's force below which a track has been lifted, and below which the fit moves it only in part: the
bell of a finger being lifted slides to its neighbour"""
TOGETHER_S = 1.0
"""two fingers do not stay in one place for longer: the weaker one has been lifted there"""
EM_STEPS = 2
"""EM iterations per frame; each frame starts from the result of the last one"""
WIDTH_GAIN = 0.2
"""gain per frame with which the width of a bell follows the fit, while each bell has its own maximum"""
LEAST_WIDTH_PITCHES = 0.5
"""least standard deviation of a bell: that of a contact on one cell"""
