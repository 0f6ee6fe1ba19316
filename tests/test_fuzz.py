"""A bounded run of the fuzzer; ``python -m tests.fuzz`` goes on for as long as one likes."""

from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz.formats import FORMATS

ROOT = Path(__file__).parent.parent
CASES = 40


def test_a_bounded_run_finds_nothing() -> None:
    command = [sys.executable, "-m", "tests.fuzz", "--cases", str(CASES), "--seconds", "1e9"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    table = [line.split() for line in done.stdout.splitlines()[1:]]
    assert {line[0]: int(line[1]) for line in table} == dict.fromkeys(FORMATS, CASES)
    for name, _, accepted, refused, found in table:
        assert int(accepted), f"{name}: no case was accepted, so nothing was compared"
        assert int(refused), f"{name}: no case was refused"
        assert not int(found)


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_valid_is_accepted(name: str, tmp_path: Path) -> None:
    for seed in range(3):
        rng = random.Random(seed)
        assert FORMATS[name].judge(FORMATS[name].valid(rng), rng, tmp_path) == "accepted"
