"""The design verification report: requirements on a design, and the paper's claims P1 to P14 as experiments.

``verify(design).write("folder")`` runs them and writes ``report.html``, ``report.json``, ``junit.xml`` and more.
"""

from ._catalogue import CATALOGUE, Quantity
from ._explore import Remedy, Variation, best_carbon_black, carbon_black_line, explore, remedies
from ._explore import picture as explore_picture
from ._record import ReportRecord, load_record, schema
from ._report import Report
from ._requirements import check_requirements, default_requirements, load_requirements
from ._run import prototype, verify
from ._subject import Subject

__all__ = [
    "CATALOGUE",
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
