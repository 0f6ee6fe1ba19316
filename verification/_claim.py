"""A claim of the paper and its experiment."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from ._dut import DesignUnderTest
from ._outcome import Attempt, Check, Claim, Finding, attempted


class Statement(NamedTuple):
    """What the paper states, and the experiment that answers it: None or an exception where there is no answer."""

    id: str
    title: str
    where: str
    says: str
    experiment: Callable[[DesignUnderTest], Finding]

    def claim(self, found: Attempt[Finding]) -> Claim:
        """With what was found, or the reason why nothing was."""
        finding = found.found
        if finding is None:
            checks = [] if found.inapplicable else [Check("experiment", None, 0.0, reason=found.reason)]
            finding = Finding(checks, inapplicable=found.reason if found.inapplicable else "")
        return Claim(self.id, self.title, self.where, self.says, finding, found.seconds)

    def tried(self, dut: DesignUnderTest) -> Claim:
        """The claim after its experiment on a design, whatever happens."""
        return self.claim(attempted(lambda: self.experiment(dut)))


def statement(
    id: str, title: str, where: str, says: str
) -> Callable[[Callable[[DesignUnderTest], Finding]], Statement]:
    """Makes a function of a design the experiment of a numbered claim."""
    return lambda experiment: Statement(id, title, where, says, experiment)
