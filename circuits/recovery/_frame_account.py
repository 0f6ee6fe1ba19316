"""Cost account of one frame: every step pays its price before it begins.

The unit is a microsecond of the development machine when idle. Prices are formulas of the array's size, measured once.
The work of a frame is thus the same on every machine, in every run and in a replay; no clock decides. Only the ratio of
a price to the price of a usual frame counts, and other machines hardly change this ratio.

A frame may cost as much as :data:`USUAL_FRAMES` usual ones. Steps that it cannot pay for are left out. Cells that
depend on them are not valid, and the next frame continues.
"""

from __future__ import annotations

USUAL_FRAMES = 9.0
"""cost limit of a frame, in usual frames: prices are true to about a tenth"""
FIRST_FRAMES = 60.0
"""the same for the first frame of all, before which nothing is known"""


class Account:
    """The amount that one frame has left."""

    def __init__(self, most: float) -> None:
        """For a frame that may cost ``most``."""
        self.left = most

    def pay(self, price: float) -> bool:
        """Pay for a step. False, and nothing is paid, if too little is left."""
        paid = price <= self.left
        if paid:
            self.left -= price
        return paid

    def spend(self, price: float) -> None:
        """Pay for work that the frame does in any case."""
        self.left -= price

    def can_pay(self, price: float) -> bool:
        """Whether enough is left."""
        return price <= self.left

    def times(self, price: float, most: int) -> int:
        """How many times, up to ``most``, a price can be paid."""
        return most if price * most <= self.left else max(int(self.left / price), 0)
