"""Streams of random boards that the live recovery once misread, most of them by a factor of two and more.

Leads like the cells, shorts that join lines, offsets that push outputs below the range, noise that begins, breaks:
readings for which two sets of cells nearly agree.
"""

from __future__ import annotations

import pytest
from misread_streams import NAMES, stream

from ohmskin.bench import _live_search

ENDLESS = {"inverting:6120000145", "row:50000086"}


@pytest.mark.parametrize("name", sorted({*NAMES} - ENDLESS))
def test_streams_that_were_once_misread(name: str) -> None:
    tally = _live_search.LiveTally()
    _live_search.compare(name, stream(name), tally)
    assert tally.findings == []
    assert tally.valid or not name.startswith("feedback pressed")


@pytest.mark.parametrize("name", sorted(ENDLESS))
def test_streams_on_which_no_iteration_comes_to_an_end_have_no_wrong_cell(name: str) -> None:
    """Shorts behind heavy leads with segments: Kirchhoff's laws without segments lead round in a circle."""
    tally = _live_search.LiveTally()
    _live_search.compare(name, stream(name), tally)
    assert tally.count("wrong cell") == tally.count("factor of two") == tally.count("unsolved") == 0
