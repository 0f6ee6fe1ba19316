"""Discovery of boards: every serial port is opened and asked for a board."""

from __future__ import annotations

import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from ..common.checks import count, path_text, positive
from ..common.text import shown
from ..errors import InputError, LinkError, OhmskinError
from ..wire import Family, FramePacket, Identity, Order, board_family, host_protocol
from ._port import open_port
from ._port_names import emulated_ports, serial_ports, usb_serial_number
from ._tuning import ANSWER_S, SEARCH_S


@dataclass(frozen=True, slots=True)
class FoundBoard:
    """A port with a board."""

    port: str
    """name to open"""
    serial_number: str
    """from the board; empty if its family has no such packet"""
    firmware: str
    rows: int
    columns: int
    usb_serial_number: str | None
    """serial number of the port's USB device"""


def discover(
    ports: Iterable[str] | None = None,
    *,
    board: str | Path | Family = "ohmskin",
    baudrate: int | None = None,
    timeout: float = SEARCH_S,
) -> list[FoundBoard]:
    """The boards that answer, sorted by serial number.

    All ports are opened for a moment, at the same time. Ports in use are left out, and ports where nothing answers in
    the protocol of the family.

    Args:
        ports: names to try; None: all serial ports that the operating system lists, and the pseudo-terminals and
            sockets of boards that this user emulates on this machine.
        board: family of the boards, by name or as an object, or the BOARD.toml that describes them.
        baudrate: of the UARTs; None: that of the family.
        timeout: s to wait for an answer.

    Raises:
        InputError: there is no such family, ``ports`` is a single name, or ``timeout`` is not above 0.

    """
    family = board_family(board)
    if baudrate is not None:
        family = replace(family, baud_rate=count("baudrate", baudrate))
    positive("timeout", timeout, "s")
    if isinstance(ports, str) or not isinstance(ports, Iterable | None):
        raise InputError(f"ports is {shown(ports)}; expected a list of names")
    asked = [*serial_ports(), *emulated_ports()] if ports is None else ports
    names = list(dict.fromkeys(path_text("port", name, "the name of a port") for name in asked))
    if not names:
        return []
    with ThreadPoolExecutor(max_workers=min(len(names), 32)) as pool:
        answers = pool.map(lambda name: _ask(name, family, timeout), names)
        found = [answer for answer in answers if answer is not None]
    return sorted(found, key=lambda entry: (entry.serial_number, entry.port))


def find_board(
    serial_number: str,
    ports: Iterable[str] | None = None,
    *,
    board: str | Path | Family = "ohmskin",
    timeout: float = ANSWER_S,
) -> str:
    """The port of the board with this serial number, its own or that of its USB device.

    Ports are asked for :data:`SEARCH_S`, and again for ``timeout`` if the board is not among those that answered: a
    board that restarts whenever its port is opened takes longer.

    Raises:
        LinkError: there is no such board, or more than one; the message lists the boards that are there.

    """
    matching: list[str] = []
    for limit_s in (min(SEARCH_S, timeout), timeout):
        found = discover(ports, board=board, timeout=limit_s)
        matching = [entry.port for entry in found if serial_number in (entry.serial_number, entry.usb_serial_number)]
        if matching or limit_s == timeout:
            break
    if len(matching) > 1:
        raise LinkError(
            f"{len(matching)} boards with serial number {serial_number}: at {', '.join(matching)}; give a port"
        )
    if matching:
        return matching[0]
    present = ", ".join(f"{entry.serial_number or '?'} at {entry.port}" for entry in found) or "none"
    raise LinkError(f"no board with serial number {serial_number} at a port that is free; boards present: {present}")


def _ask(name: str, family: Family, timeout_s: float) -> FoundBoard | None:
    """The board behind one port, or None."""
    protocol = host_protocol(family)
    try:
        port = open_port(name, baudrate=family.baud_rate, dtr=family.dtr, rts=family.rts)
    except LinkError:
        return None
    # A board with an identity packet need not send frames to answer; at the fast clock it would spend its time on them.
    knock = [Order.START, Order.ONE_FRAME] if family.polled else [] if family.has_description else [Order.START]
    orders = [Order.IDENTIFY, *knock]
    try:
        deadline = time.monotonic() + timeout_s
        ask_at = 0.0
        while (now := time.monotonic()) < deadline:
            if now >= ask_at:
                for order in orders:
                    port.write(protocol.request(order))
                ask_at = now + timeout_s / 3
            port.wait(min(ask_at, deadline) - now)
            arrival = port.read()
            for event in protocol.feed(arrival.data, arrival.received_at):
                if isinstance(event, Identity) or (isinstance(event, FramePacket) and not family.has_description):
                    said = (event.serial_number, event.firmware) if isinstance(event, Identity) else ("", "")
                    return FoundBoard(name, *said, event.rows, event.columns, usb_serial_number(name))
    except OhmskinError:
        return None
    finally:
        port.close()
    return None
