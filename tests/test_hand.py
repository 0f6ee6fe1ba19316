"""Loads set by hand are loads like those of a scene."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from boards import scene

from ohmskin.emulator import Board, Hand, Scene
from ohmskin.errors import InputError, LinkTimeout

CELL, KPA = (1, 1), 9.0


def _scene(*contacts: dict[str, object]) -> Scene:
    return scene(board={"frame_rate": 100.0, "noise": 1e-4}, contact=list(contacts))


def _pressed_at_tick(board: Board, hand: Hand, tick: int, pressure: np.ndarray) -> list[list[bytes]]:
    """Packets of 60 ticks; another thread presses just before ``tick``."""
    packets = [board.tick() for _ in range(tick)]
    since: list[float] = []
    presser = threading.Thread(target=lambda: since.append(hand.press(pressure)))
    presser.start()
    while not hand.wanted:
        time.sleep(0.001)
    packets.append(board.tick())
    presser.join()
    assert since == [tick / 100.0]
    return packets + [board.tick() for _ in range(59 - tick)]


@pytest.mark.parametrize("tick", [0, 17])
def test_the_hand_presses_as_a_contact_does(tick: int) -> None:
    """Bit for bit, though the frames after the press had been computed without it."""
    shape = _scene().skin.design.array.shape
    pressure = np.zeros(shape)
    pressure[CELL] = KPA
    at = tick / 100.0
    load = [[0.0, KPA]] if tick == 0 else [[0.0, 0.0], [at - 0.005, 0.0], [at - 0.005, KPA]]
    contact = {"cells": [list(CELL)], "load_kpa": load}
    hand = Hand(shape)
    by_hand = _pressed_at_tick(Board(_scene(), hand=hand), hand, tick, pressure)
    written = Board(_scene(contact))
    assert by_hand == [written.tick() for _ in range(60)]


def test_a_released_skin_recovers() -> None:
    hand = Hand(_scene().skin.design.array.shape)
    samples: list[float] = []
    board = Board(_scene(), hand=hand, record=lambda sample: samples.append(sample.pressure_kpa[CELL]))
    pressure = np.zeros(hand.shape)
    pressure[CELL] = KPA
    for load in (pressure, 0.0):
        presser = threading.Thread(target=hand.press, args=(load,))
        presser.start()
        while presser.is_alive():
            board.tick()
    pressed = samples.index(KPA)
    released = samples.index(0.0, pressed)
    assert set(samples[pressed:released]) == {KPA}
    assert set(samples[released:]) == {0.0}


def test_a_load_that_makes_no_sense_is_refused() -> None:
    hand = Hand((4, 4))
    for load in (-1.0, np.nan, np.inf, np.zeros((3, 3))):
        with pytest.raises(InputError, match="pressure_kpa"):
            hand.press(load)
    with pytest.raises(LinkTimeout, match="no board took the load"):
        hand.press(1.0, timeout_s=0.01)
