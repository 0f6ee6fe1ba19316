"""The design verification report: the paper's claims P1 to P14 as experiments on a design.

``verify(design).write("folder")`` runs them and writes ``report.html``, ``report.json`` and ``junit.xml``.
"""

from ._report import Report
from ._run import prototype, verify

__all__ = ["Report", "prototype", "verify"]
