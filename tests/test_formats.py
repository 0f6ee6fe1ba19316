"""Drafts of boards' formats (:mod:`formats`): none wrong without a question, and time and number taken over."""

from __future__ import annotations

import pytest
from formats import FORMATS, judged


@pytest.mark.parametrize("name", FORMATS)
def test_a_draft_reads_what_was_sent(name: str) -> None:
    one = judged(FORMATS[name], baud=None)
    assert one.outcome in ("right", "asked")
    assert set(one.kept) >= set(FORMATS[name].keeps)
    assert one.found is not None
    assert (one.outcome == "right") or one.found.questions
