"""``python -m tests.fuzz``: mutated inputs of every format, for as long as you like.

Each case follows from the seed, its format and its number alone, so that ``--case`` repeats it. The address space of
the process and the processor time of a case are limited: a reader that eats memory or hangs is a finding like a wrong
answer.
"""

from __future__ import annotations

import argparse
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from .formats import FORMATS, Format


class TooSlow(BaseException):
    """One case took more processor time than a case may take."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; exit code 1 when anything was found."""
    options = _parser().parse_args(arguments)
    resource.setrlimit(resource.RLIMIT_AS, (options.memory * 2**20,) * 2)
    signal.signal(signal.SIGPROF, _too_slow)
    formats = [FORMATS[name] for name in options.only or FORMATS]
    counts: dict[str, Counter[str]] = {entry.name: Counter() for entry in formats}
    end = time.monotonic() + options.seconds
    number = options.case or 0
    try:
        while options.case is not None or (number < options.cases and time.monotonic() < end):
            if sum(count["found"] for count in counts.values()) >= options.most:
                break
            for entry in formats:
                counts[entry.name][_outcome(entry, options, number)] += 1
            if options.case is not None:
                break
            number += 1
    except KeyboardInterrupt:
        pass
    print(f"{'format':<10} {'cases':>9} {'accepted':>9} {'refused':>9} {'found':>6}   (seed {options.seed})")
    for name, count in counts.items():
        cases, found = sum(count.values()), count["found"]
        print(f"{name:<10} {cases:>9} {count['accepted']:>9} {count['refused']:>9} {found:>6}")
    return 1 if any(count["found"] for count in counts.values()) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to go on [60]")
    parser.add_argument("--cases", type=int, default=10**12, help="how many cases of each format at most")
    parser.add_argument("--seed", type=int, default=0, help="another seed makes other cases [0]")
    parser.add_argument("--only", nargs="+", choices=FORMATS, metavar="FORMAT", help=f"some of {', '.join(FORMATS)}")
    parser.add_argument("--case", type=int, help="run this one case of each format, and show its input")
    parser.add_argument("--memory", type=int, default=4096, help="address space in MiB [4096]")
    parser.add_argument("--limit", type=float, default=60.0, help="processor seconds that one case may take [60]")
    parser.add_argument("--most", type=int, default=50, help="stop after so many findings [50]")
    parser.add_argument("--keep", type=Path, help="folder for the inputs of what is found")
    return parser


def _outcome(entry: Format, options: argparse.Namespace, number: int) -> str:
    """Run one case: "accepted", "refused" or "found"."""
    rng = random.Random(f"{options.seed}:{entry.name}:{number}")
    data = entry.case(rng)
    if options.case is not None:
        print(f"{entry.name} {number}: {data!r}")
    signal.setitimer(signal.ITIMER_PROF, options.limit)
    try:
        with tempfile.TemporaryDirectory() as folder:
            return entry.judge(data, rng, Path(folder))
    except (Exception, TooSlow) as error:
        signal.setitimer(signal.ITIMER_PROF, 0)
        repeat = f"python -m tests.fuzz --only {entry.name} --seed {options.seed} --case {number}"
        print(f"FOUND {entry.name}: {type(error).__name__}: {str(error)[:300]}\n  {repeat}", flush=True)
        if options.case is not None:
            traceback.print_exc()
        if options.keep is not None:
            options.keep.mkdir(parents=True, exist_ok=True)
            (options.keep / f"{entry.name}-{options.seed}-{number}").write_bytes(data)
        return "found"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _too_slow(number: int, frame: FrameType | None) -> None:
    raise TooSlow("the case takes too long")


if __name__ == "__main__":
    sys.exit(main())
