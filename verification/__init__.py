"""The design verification report: requirements on a design, and the paper's claims P1 to P14 as experiments.

``verify(design).write("folder")`` runs them and writes ``report.html``, ``report.json``, ``junit.xml`` and more.
"""

from ._catalogue import CATALOGUE, Quantity
from ._record import ReportRecord, load_record, schema
from ._report import Report
from ._requirements import default_requirements, load_requirements
from ._run import prototype, verify

__all__ = [
    "CATALOGUE",
    "Quantity",
    "Report",
    "ReportRecord",
    "default_requirements",
    "load_record",
    "load_requirements",
    "prototype",
    "schema",
    "verify",
]
