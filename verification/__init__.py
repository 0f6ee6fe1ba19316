"""The design verification report: requirements on a design, and the paper's claims P1 to P14 as experiments.

``verify(design).write("folder")`` runs them and writes ``report.html``, ``report.json``, ``junit.xml`` and more.

Requirements:

=======================  ==============================================================================
:mod:`._run`             one verification: requirements and claims, in processes, reported as they come
:mod:`._dut`             the design under test: design, cell, board, samples and seed
:mod:`._requirements`    requirements from files, the shipped ones, and how one is judged
:mod:`._catalogue`       the quantities that a requirement may limit, one file each in :mod:`.quantities`
:mod:`._quantity`        what a quantity states: how it is found, its limits, what mends and who checks it
:mod:`._judging`         from a target to a measurement
:mod:`._own_code`        quantities of a design's own
:mod:`._pressures`       from load to estimate, end to end
:mod:`._hardware`        the same quantities, measured on a board
:mod:`._spice_check`     the same quantities by ngspice
=======================  ==============================================================================

Which boards are looked at:

=======================  ==============================================================================
:mod:`._parameters`      tolerances as factors; corners and random boards made of them
:mod:`._box`             the box of all boards and presses
:mod:`._search`          the one search for the worst case of any target
:mod:`._readings`        targets of settled readings; :mod:`._scale`: the unit of their errors
:mod:`._whole_board`     targets of whole boards: settling, scan rate, stability, operating point
:mod:`._montecarlo`      random boards, and their yield
:mod:`._explore`         variations, their trade-off, and what would mend a requirement
:mod:`._assumptions`     what a verdict leaves out
:mod:`._tuning`          effort of searches and samples: all tuned numbers, with what sets them
=======================  ==============================================================================

The paper's claims (:mod:`._claim`):

=======================  ==============================================================================
:mod:`._material`        P1 to P9
:mod:`._crosstalk`       P10 to P13
:mod:`._whole_skin`      P14
=======================  ==============================================================================

The report: :mod:`._report`, :mod:`._sign_off` (its page to sign), :mod:`._record` (its JSON), :mod:`._outcome` (what it
is made of), :mod:`._schematic` and :mod:`._pictures`, :mod:`._units`, :mod:`._export` (tables).
"""

from ._catalogue import CATALOGUE
from ._dut import DesignUnderTest
from ._explore import Remedy, Variation, best_carbon_black, carbon_black_line, explore, remedies, with_front
from ._explore import picture as explore_picture
from ._outcome import Claim, Result
from ._quantity import Quantity
from ._record import Outcome, ReportRecord, load_record, schema
from ._report import Report
from ._requirements import at_ratings, check_requirements, default_requirements, load_requirements
from ._run import prototype, verify

__all__ = [
    "CATALOGUE",
    "Claim",
    "DesignUnderTest",
    "Outcome",
    "Quantity",
    "Remedy",
    "Report",
    "ReportRecord",
    "Result",
    "Variation",
    "at_ratings",
    "best_carbon_black",
    "carbon_black_line",
    "check_requirements",
    "default_requirements",
    "explore",
    "explore_picture",
    "load_record",
    "load_requirements",
    "prototype",
    "remedies",
    "schema",
    "verify",
    "with_front",
]
