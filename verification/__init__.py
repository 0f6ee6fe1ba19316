"""The design verification report: requirements on a design, and the paper's claims P1 to P14 as experiments.

``verify(design).write("folder")`` runs them and writes ``report.html``, ``report.json``, ``junit.xml`` and more.

Requirements:

=======================  ==============================================================================
:mod:`._run`             one verification: requirements and claims, in processes, kept as they come
:mod:`._subject`         what is judged: design, cell, board under test, samples and seed
:mod:`._requirements`    requirements from files, the shipped ones, and how one is judged
:mod:`._catalogue`       the quantities that a requirement may limit
:mod:`._static`          quantities of settled readings
:mod:`._dynamic`         settling, stability, noise, the line to the host
:mod:`._chain`           pressure errors, from load to estimate
:mod:`._stress`          voltage, current and power of parts and cells
:mod:`._self_test`       faults that a board can tell by itself
:mod:`._hardware`        the same quantities, measured on a board
:mod:`._spice_check`     the same quantities by ngspice
=======================  ==============================================================================

Which boards are looked at:

=======================  ==============================================================================
:mod:`._parameters`      tolerances as factors; corners and random boards made of them
:mod:`._targets`         quantities as functions of a board and a press, for the search
:mod:`._corner`          the one search for the worst case of any quantity
:mod:`._montecarlo`      the yield of random boards
:mod:`._explore`         variations, their trade-off, and what would mend a requirement
:mod:`._assumptions`     what a verdict leaves out
=======================  ==============================================================================

The paper's claims (:mod:`._claims`):

=======================  ==============================================================================
:mod:`._mixture`         P1
:mod:`._material`        P2 to P9
:mod:`._crosstalk`       P10 to P13
:mod:`._whole_skin`      P14
=======================  ==============================================================================

The report: :mod:`._report`, :mod:`._record` (its JSON), :mod:`._outcome` (what it is made of), :mod:`._schematic` and
:mod:`._maps` (pictures), :mod:`._units`, :mod:`._export` (tables for other programs).
"""

from ._catalogue import CATALOGUE, Quantity
from ._explore import Remedy, Variation, best_carbon_black, carbon_black_line, explore, remedies
from ._explore import picture as explore_picture
from ._outcome import Outcome
from ._record import ReportRecord, load_record, schema
from ._report import Report
from ._requirements import check_requirements, default_requirements, load_requirements
from ._run import prototype, verify
from ._subject import Subject

__all__ = [
    "CATALOGUE",
    "Outcome",
    "Quantity",
    "Remedy",
    "Report",
    "ReportRecord",
    "Subject",
    "Variation",
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
]
