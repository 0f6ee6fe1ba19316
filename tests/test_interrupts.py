"""A reader that is interrupted again and again gets every frame that it is told of, and never waits for ever."""

from __future__ import annotations

import random
import signal
import threading
import time
from types import FrameType

import pytest
from boards import scene

from ohmskin.driver import Skin
from ohmskin.emulator import PtyPort, running

INTERRUPTS = 300


@pytest.mark.slow
def test_interrupts_lose_no_count_and_no_lock() -> None:
    armed = False
    hits = contradictions = 0

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal armed
        if armed:
            armed = False
            raise KeyboardInterrupt

    def pester(ended: threading.Event) -> None:
        rng, main = random.Random(1), threading.main_thread().ident
        assert main is not None
        while not ended.is_set():
            time.sleep(rng.uniform(0.0, 0.01))
            signal.pthread_kill(main, signal.SIGUSR1)

    before_handler = signal.signal(signal.SIGUSR1, interrupt)
    ended = threading.Event()
    pesterer = threading.Thread(target=pester, args=(ended,))
    port = PtyPort()
    try:
        with running(scene(board={"frame_rate": 200.0}), port), Skin.open(port.name, delivery="every") as skin:
            before = skin.read()
            pesterer.start()
            while hits < INTERRUPTS:
                try:
                    armed = True
                    while True:
                        frame = skin.read(30.0)
                        missing = frame.sequence - before.sequence - 1
                        contradictions += missing != frame.lost_before + frame.skipped_before
                        before = frame
                except KeyboardInterrupt:
                    hits += 1
            ended.set()
            pesterer.join()
            assert skin.read(30.0).sequence > before.sequence
    finally:
        ended.set()
        pesterer.join()
        signal.signal(signal.SIGUSR1, before_handler)
    assert not contradictions
