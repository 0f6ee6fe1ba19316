"""Streams of random boards that the live recovery once misread, most of them by a factor of two and more.

Leads like the cells, shorts that join lines, offsets that push outputs below the range, noise that begins, breaks:
readings for which two sets of cells nearly agree. ``python -m ohmskin.bench.search --live --show FAMILY:NUMBER``
shows one.
"""

from __future__ import annotations

import pytest

from ohmskin.bench import _live_search

MISREAD: dict[str, tuple[int, ...]] = {
    "inverting": (
        210000031,
        210000308,
        310000132,
        310000557,
        210000679,
        93010000031,
        910000697,
        91010000068,
    ),
    "row": (
        210000527,
        910000038,
    ),
    "row events": (
        5010000145,
        3050000679,
        3020000137,
        6120000231,
    ),
    "inverting events": (
        3010000006,
        3010000024,
        3010000026,
        3010000074,
        3010000119,
        3010000137,
        3010000151,
        3060000369,
        3030000911,
        555000002,
    ),
    "row extremes": (
        202010000038,
        97950000168,
    ),
    "inverting extremes": (
        202020000095,
        201010000046,
        201050000042,
        97950000151,
    ),
    "feedback": (
        910000116,
        3010000245,
        2020000241,
        70020000174,
        3010000064,
        91020000131,
    ),
    "feedback events": (
        6120000094,
        4010000738,
        4010000029,
        5010000130,
        70020000107,
    ),
    "loaded events": (
        4030000106,
        4010000610,
        4030000002,
        6130000060,
        70030000121,
    ),
    "floating events": (
        4030000019,
        6120000299,
    ),
    "open divider events": (4010000269,),
    "divider": (
        310000415,
        910000216,
        910000404,
        310000401,
    ),
    "loaded": (
        410000126,
        3010000430,
    ),
    "divider events": (
        6120000271,
        91010000227,
    ),
    "feedback extremes": (
        202010000032,
        202020000221,
        202020000238,
    ),
    "divider extremes": (202020000179,),
    "row floating extremes": (202020000198,),
    "loaded extremes": (201040000012,),
    "loaded twofold": (
        10000091,
        10000161,
        10000184,
        60000021,
        30000924,
        140000286,
    ),
    "divider twofold": (
        10000028,
        10000135,
        20000023,
        60000073,
    ),
}


@pytest.mark.parametrize(("family", "number"), [(each, number) for each in MISREAD for number in MISREAD[each]])
def test_streams_that_were_once_misread(family: str, number: int) -> None:
    tally = _live_search.LiveTally()
    _live_search.check(family, number, tally)
    assert tally.findings == []


@pytest.mark.parametrize(("family", "number"), [("inverting", 6120000145), ("row", 50000086)])
def test_streams_on_which_no_iteration_comes_to_an_end_have_no_wrong_cell(family: str, number: int) -> None:
    """Shorts behind heavy leads with segments: Kirchhoff's laws without segments lead round in a circle."""
    tally = _live_search.LiveTally()
    _live_search.check(family, number, tally)
    assert tally.count("wrong cell") == tally.count("factor of two") == tally.count("unsolved") == 0
