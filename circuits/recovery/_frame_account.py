"""What one frame may cost: the account into which every step of a frame pays before it is begun.

The unit is a microsecond of the development machine with nothing else to do: prices are formulas of the array's size,
which were measured once. A frame's work is thus the same on every machine, in every run and in a replay, and no clock
decides. What counts is the ratio of a price to that of a usual frame, which other machines hardly change.

A frame has :data:`USUAL_FRAMES` usual ones. What it cannot pay for is not done; cells that this leaves open are not
valid, and the next frame goes on.
"""

from __future__ import annotations

USUAL_FRAMES = 9.0
"""that a frame may cost: prices are true to about a tenth"""
FIRST_FRAMES = 60.0
"""the same of the first frame of all, before which nothing is known"""


class Account:
    """What one frame has left."""

    def __init__(self, most: float) -> None:
        """For a frame that may cost ``most``."""
        self.left = most

    def pay(self, price: float) -> bool:
        """Pay for a step. False, and nothing is paid, where too little is left."""
        paid = price <= self.left
        if paid:
            self.left -= price
        return paid

    def spend(self, price: float) -> None:
        """Pay for what the frame does in any case."""
        self.left -= price

    def can_pay(self, price: float) -> bool:
        """Whether enough is left."""
        return price <= self.left

    def times(self, price: float, most: int) -> int:
        """How many times, up to ``most``, a price can be paid."""
        return most if price * most <= self.left else max(int(self.left / price), 0)
