"""Streams of random boards that the live recovery once misread, most of them by a factor of two and more.

Leads like the cells, shorts that join lines, offsets that push outputs below the range, noise that begins, breaks:
readings for which two sets of cells nearly agree.
"""

from __future__ import annotations

import pytest
from misread_streams import NAMES, stream

from ohmskin.bench import _live_search, _live_streams

ENDLESS = {"inverting:6120000145", "row:50000086", "loaded:30000112", "loaded:900017"}


@pytest.mark.parametrize("name", sorted({*NAMES} - ENDLESS))
def test_streams_that_were_once_misread(name: str) -> None:
    tally, read_from = _live_search.LiveTally(), stream(name)
    _live_search.compare(name, read_from, tally)
    assert tally.findings == []
    # Without leads of the columns, a pressed skin reads like one of a few ohm.
    assert tally.valid or not (name.startswith("feedback pressed") and read_from.design.array.column_lead)


@pytest.mark.parametrize("name", sorted(ENDLESS & {*NAMES}))
def test_streams_on_which_no_iteration_comes_to_an_end_have_no_wrong_cell(name: str) -> None:
    """Shorts behind heavy leads with segments: Kirchhoff's laws without segments lead round in a circle."""
    tally = _live_search.LiveTally()
    _live_search.compare(name, stream(name), tally)
    assert tally.count("wrong cell") == tally.count("factor of two") == tally.count("unsolved") == 0


FOUND = {
    "columns that are not read stand behind their leads": ["feedback:570000042"],
    "of two joined columns each reads what remains to it": [
        f"row floating:{number}" for number in (670000060, 610000168, 620000101, 630000057)
    ],
    "what passes beside a cell is more than the cell": ["feedback:600000040"],
    "steps that are short far from the readings": ["feedback:680000079"],
    "cells of an ohm or less read like kiloohms": ["feedback:620000130", "feedback:550000045"],
    "a bridge joins columns whose readings have several answers": ["multiplexed:610000138"],
    "a valley that derivatives at its middle do not show": ["loaded:30000112", "loaded:30000070", "loaded:110000049"],
    "a row beside cells below the range": ["floating:30000069", "inverting:30000015"],
    "a fit that is damped comes to its end": [
        "pulled divider:30000100",
        "open loaded:30000040",
        "open divider:30000087",
    ],
    "a node without a connection": ["open divider:30000041"],
    "what others leave open does not wait": ["divider:30000046"],
    "segments as heavy as the cells": ["feedback:30000022"],
    "an open line says nothing of usual cells": ["row:440000149", "row:440000167", "row:430000086"],
    "floating rows that join columns": [f"multiplexed:410000{number}" for number in (219, 239, 263, 286)],
    "an idle column stands elsewhere than the one that is read": ["multiplexed:430000163"],
    "saturated cells of one column beside each other": ["inverting:900037", "inverting:900078"],
    "what cells draw that are bounded beside all others adds up": ["row:7149"],
    "shorts in the only row": ["feedback:440000146"],
    "readings of less than nothing in a row without drive": ["divider:570000055", "inverting:610000142"],
    "a pressed column with segments beside cells at a limit": ["inverting:530000015"],
    "what offsets feed into a floating row": ["row floating:540000054"],
    "a fit that creeps along a valley": ["loaded:900017"],
    "a cell at a limit that stands elsewhere than at its end": ["open loaded:530000067"],
    "a column of open scale": ["divider:530000135"],
    "an open cell of which the law makes less than nothing": ["inverting:530000042"],
    "steps that are small beside each cell's deviation": ["pulled divider:430000020"],
    "what hardly known cells have left to go": [f"pulled divider:{number}" for number in (440000031, 210000034)],
    "a cell at a limit is not at its end where the others are": ["pulled divider:430000107", "open loaded:440000140"],
    "cells that hardly conduct bend the way of their logarithms": [
        *(f"pulled divider:{number}" for number in (610000182, 900013)),
        *("divider:550000076", "open divider:600000023", "open divider:600000004"),
    ],
    "two shorts that may be complete": ["loaded:650000038"],
    "lines that no cell holds": ["open divider:210000053", "pulled divider:600000078"],
    "what steps have left lies within where derivatives hold": ["divider:680000149", "open loaded:670000033"],
    "noise of few readings, and noise that returns": ["divider:440000249", "inverting:430000021"],
}


@pytest.mark.parametrize("name", [name for names in FOUND.values() for name in names])
def test_streams_that_the_search_has_found(name: str) -> None:
    family, number = name.split(":")
    stream, tally = _live_streams.stream(family, int(number)), _live_search.LiveTally()
    assert stream is not None
    _live_search.compare(name, stream, tally)
    assert [found for found in tally.findings if name not in ENDLESS or not found.startswith("unsettled")] == []
