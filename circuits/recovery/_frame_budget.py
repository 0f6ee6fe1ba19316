"""Budget of one frame of a coupled board: every stage pays from it before it begins.

An :class:`Effort` limits the number of steps of each kind in a frame, and an :class:`.Account` limits their cost. Work
beyond the budget is left to the next frames. Until then, cells that are not settled are not valid.
"""

from __future__ import annotations

from typing import NamedTuple

from ._frame_account import Account


class Effort(NamedTuple):
    """Largest number of steps of each kind in a frame."""

    starts: int
    """evaluations of the circuit model, and derivatives in closed form, at cells that a frame starts from"""
    evaluations: int
    """of the circuit model, in steps from there"""
    instalments: int
    """of the renewal of the derivatives, each about as much as one to five evaluations"""
    solutions: int
    """of a continuous sheet"""


USUAL_EFFORT = Effort(starts=3, evaluations=4, instalments=1, solutions=0)
ANEW_EFFORT = USUAL_EFFORT._replace(instalments=3)
"""on the way from closed formulas to a fit: on strongly coupled boards derivatives serve for one step only"""
LARGE_EFFORT = Effort(starts=3, evaluations=4, instalments=4, solutions=0)
"""of boards on which a step by the matrix of all readings by all cells is most of a usual frame"""
NODE_EFFORT = Effort(starts=3, evaluations=5, instalments=3, solutions=0)
"""of boards with floating rows and many cells, where a renewal is one inversion of a matrix with a row per line"""
FIRST_EFFORT = Effort(starts=3, evaluations=40, instalments=700, solutions=4)
"""in the first frame of all, before which nothing is known"""
SHEET_EVALUATIONS = 9
"""in a usual frame of a continuous sheet, one of whose solutions costs a hundred times as much"""


class Budget:
    """The rest of one frame's budget. Each method pays for one piece of work; False: too little is left for it."""

    def __init__(self, effort: Effort, account: Account) -> None:
        self._starts, self._evaluations, self._instalments, self._solutions = effort
        self._account = account
        self.suffices = True
        """whether everything that tells how well the cells are known has been paid for"""

    def start(self, price: float) -> bool:
        """An evaluation of the model where the frame starts from, or derivatives there in closed form."""
        paid = self._starts > 0 and self._account.pay(price)
        self._starts -= paid
        return paid

    def evaluate(self, price: float) -> bool:
        """An evaluation of the model."""
        paid = self._evaluations > 0 and self._account.pay(price)
        self._evaluations -= paid
        return paid

    def renew(self, price: float) -> bool:
        """An instalment of new derivatives."""
        paid = self._instalments > 0 and self._account.pay(price)
        self._instalments -= paid
        return paid

    def solve(self, price: float) -> bool:
        """A solution of the sheet, and the evaluation that its cells are compared by."""
        paid = self._solutions > 0 and self._evaluations > 0 and self._account.pay(price)
        self._solutions -= paid
        self._evaluations -= paid
        return paid

    def spend(self, price: float) -> None:
        """Pay for what the frame does in any case."""
        self._account.spend(price)

    def compare(self, price: float) -> bool:
        """A comparison of what may have broken."""
        return self._account.pay(price)

    def judge(self, price: float) -> bool:
        """Work that says how well the cells are known; without it the frame's cells are not valid."""
        paid = self._account.pay(price)
        self.suffices = self.suffices and paid
        return paid

    def keep_instalments(self, most: int) -> None:
        """Leave the frame no more instalments than that."""
        self._instalments = min(self._instalments, most)
