"""The diagnosis, on a made-up machine in a folder, and on this one."""

from __future__ import annotations

import grp
import json
import os
import shlex
import subprocess
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from formats import FORMATS, judged

from ohmskin.cli import run
from ohmskin.doctor import (
    Chunk,
    State,
    System,
    draft,
    examine_device,
    examine_installation,
    examine_ports,
    examine_traffic,
    has_baud_rate,
    judge,
)
from ohmskin.driver import Skin
from ohmskin.emulator import PtyPort
from ohmskin.errors import OhmskinError
from ohmskin.wire import (
    BOARDS,
    CHECKSUMS,
    BoardFile,
    Family,
    FramePacket,
    board_family,
    board_protocol,
)


@pytest.fixture
def machine(tmp_path: Path) -> System:
    """Root folder with a port that an FTDI chip serves."""
    for folder in ("dev", "sys/bus/usb-serial/devices/ttyUSB0", "proc/71/fd"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "dev/ttyUSB0").touch()
    (tmp_path / "sys/bus/usb-serial/devices/ttyUSB0/latency_timer").write_text("1\n")
    (tmp_path / "proc/71/comm").write_text("picocom\n")
    return System(tmp_path, user="maker")


def test_a_sound_port_has_no_problem(machine: System) -> None:
    findings = examine_device("/dev/ttyUSB0", machine)
    assert [finding.state for finding in findings] == [State.OK, State.OK]


def test_a_port_that_is_not_there(machine: System) -> None:
    (finding,) = examine_device("/dev/ttyUSB1", machine)
    assert (finding.state, finding.found) == (State.PROBLEM, "is not there")


def test_a_slow_latency_timer_is_named_with_the_line_that_mends_it(machine: System) -> None:
    timer = machine.path("/sys/bus/usb-serial/devices/ttyUSB0/latency_timer")
    timer.write_text("16\n")
    (finding,) = [found for found in examine_device("/dev/ttyUSB0", machine) if found.state is State.PROBLEM]
    assert "16 ms" in finding.found
    command = finding.mend.partition(" (")[0].replace("sudo ", "").replace("/sys", str(machine.path("/sys")))
    subprocess.run(["sh", "-c", command], check=True, stdout=subprocess.DEVNULL)
    assert {found.state for found in examine_device("/dev/ttyUSB0", machine)} == {State.OK}


def test_a_port_in_use_names_the_program(machine: System) -> None:
    machine.path("/proc/71/fd/5").symlink_to(machine.path("/dev/ttyUSB0"))
    (finding,) = [found for found in examine_device("/dev/ttyUSB0", machine) if found.state is State.PROBLEM]
    assert finding.found == "in use by picocom (process 71)"


def test_a_forbidden_port_names_the_group(machine: System, monkeypatch: pytest.MonkeyPatch) -> None:
    port = machine.path("/dev/ttyUSB0")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may open everything
    group = grp.getgrgid(port.stat().st_gid).gr_name
    port.chmod(0o660)
    assert shlex.split(_permission_mend(machine))[:5] == ["sudo", "usermod", "-aG", group, "maker,"]
    port.chmod(0o600)
    assert "60-ohmskin.rules" in _permission_mend(machine)
    port.chmod(0o660)
    monkeypatch.setattr(grp, "getgrnam", lambda name: SimpleNamespace(gr_mem=["maker"]))
    assert _permission_mend(machine).startswith("log out and in again")


def test_programs_that_open_ports_of_boards_by_themselves_are_named(
    machine: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    assert {finding.state for finding in examine_ports(machine)} == {State.OK}
    machine.path("/proc/71/comm").write_text("ModemManager\n")
    (finding,) = [found for found in examine_ports(machine) if found.state is State.PROBLEM]
    assert finding.subject == "ModemManager"
    assert finding.mend


def _permission_mend(machine: System) -> str:
    finding = examine_device("/dev/ttyUSB0", machine)[0]
    assert finding.state is State.PROBLEM
    assert "permission denied" in finding.found
    return finding.mend


def test_every_requirement_of_the_metadata_is_looked_at() -> None:
    shown = " ".join(finding.found for finding in examine_installation())
    for name in ("click", "numpy", "scipy", "matplotlib"):
        assert f"{name} " in shown


class Played(PtyPort):
    """A board of one family on a pty: random frames, by itself or when asked."""

    def __init__(self, family: Family) -> None:
        super().__init__()
        self._family = family
        self._protocol = board_protocol(family)
        self._rng = np.random.default_rng(0)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._live)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        super().close()

    def _live(self) -> None:
        number = 0
        while not self._ended.wait(0.02):
            asked = self._protocol.feed(self.read() or b"") if self.host_present() else []
            if asked or (not self._family.polled and self.host_present()):
                number += 1
                self.write(self._frame(number))

    def _frame(self, number: int) -> bytes:
        layout = self._family.layout
        counts = self._rng.integers(0, 2**layout.adc_bits, (layout.rows, layout.columns), dtype=np.uint16)
        return self._protocol.frame(FramePacket.of(counts, sequence=number, time_us=20_000 * number))


@pytest.mark.parametrize("name", BOARDS)
def test_a_port_sounds_like_the_board_behind_it(name: str) -> None:
    with Played(BOARDS[name]) as port:
        finding = examine_traffic(port.name, listen_s=0.5).finding
    assert finding.state is State.OK
    assert f"family '{name}'" in finding.found
    assert f"{BOARDS[name].layout.rows} x {BOARDS[name].layout.columns} cells" in finding.found


def test_a_port_that_sends_something_else_is_described() -> None:
    with PtyPort() as port:
        stop = threading.Event()

        def chatter() -> None:
            while not stop.wait(0.02):
                if port.host_present():
                    port.write(b"boot: calibrating sensor\r\n")

        thread = threading.Thread(target=chatter)
        thread.start()
        finding = examine_traffic(port.name, listen_s=0.25).finding
        stop.set()
        thread.join()
    assert finding.state is State.PROBLEM
    assert "sends what no known family does" in finding.found
    assert "100 % of them text, such as 'boot: calibrating sensor'" in finding.found
    assert "ohmskin" in finding.mend


NEUROMAT = Path(__file__).parent.parent / "examples/boards/neuromat.toml"


def test_a_draft_is_written_and_can_be_opened(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "board.toml").write_text("mine")
    with Played(board_family(NEUROMAT)) as port:
        assert run(["doctor", port.name]) == 0
        shown = capsys.readouterr().out
        assert f"ohmskin view {port.name} --board board-2.toml" in shown
        assert "frame.range: the smallest and the largest number" in shown
        with Skin.open(port.name, board="board-2.toml", timeout=20.0) as skin:
            assert skin.read().counts.shape == (8, 13)
        assert run(["doctor", port.name, "-o", "board.toml"]) == 2
    assert (tmp_path / "board.toml").read_text() == "mine"


def test_a_silent_board_is_sent_words_only_where_that_is_allowed() -> None:
    tables = {
        "board": {"name": "asked", "rows": 4, "columns": 5, "bits": 10},
        "frame": {"format": "text", "layout": "frame-per-line"},
        "start": {"poll": "T"},
    }
    with Played(BoardFile.parse(tables, "here").family()) as port:
        silent = examine_traffic(port.name, listen_s=0.25, poke=lambda: False)
        assert silent.draft is None
        found = examine_traffic(port.name, listen_s=0.5, poke=lambda: True).draft
    assert found is not None
    assert found.guess.tables["start"] == {"poll": "T"}
    assert found.guess.tables["board"]["rows"] * found.guess.tables["board"]["columns"] == 20


class Asked(PtyPort):
    """A board that says so while it waits for ``s``, then sends frames until it has heard nothing for a while."""

    def __init__(self, alive_s: float) -> None:
        super().__init__()
        self._alive_s, self._ended = alive_s, threading.Event()
        self._thread = threading.Thread(target=self._live)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        super().close()

    def _live(self) -> None:
        rng, until, turns = np.random.default_rng(0), 0.0, 0
        while not self._ended.wait(0.02):
            if b"s" in (self.read() or b""):
                until = time.monotonic() + self._alive_s
            turns += 1
            if time.monotonic() < until:
                self.write(",".join(map(str, rng.integers(0, 900, 20))).encode() + b"\r\n")
            elif self.host_present() and turns % 5 == 0:
                self.write(b"waiting for s\r\n")


def test_a_board_that_waits_with_words_is_started_and_kept_awake(tmp_path: Path) -> None:
    with Asked(0.8) as port:
        assert examine_traffic(port.name, listen_s=0.5, poke=lambda: False).draft is None
        found = examine_traffic(port.name, listen_s=0.5, poke=lambda: True).draft
        assert found is not None
        start = found.guess.tables["start"]
        assert start["send"] == "s"
        assert 0.1 < start["every"] < 0.8
        path = tmp_path / "asked.toml"
        path.write_text(found.toml([]))
        with Skin.open(port.name, board=str(path), timeout=20.0, delivery="every") as skin:
            for _ in range(100):  # more than fit into the time that it stays awake
                skin.read(20.0)
            assert skin.stats().corrupt < 30


@pytest.mark.usefixtures("silent_board")
def test_a_board_that_is_not_understood_is_drafted_at_once_if_the_person_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ohmskin.cli._skin_options.Skin.open", partial(Skin.open, timeout=5.0))
    record = ["record", "", "-o", "press.mcap", "--duration", "1"]
    with Played(board_family(NEUROMAT)) as port:
        record[1] = port.name
        assert run(record) == 2
        refused = capsys.readouterr().err
        assert f"`ohmskin doctor {port.name}`" in refused
        assert "text such as" in refused
        monkeypatch.setattr("ohmskin.cli._skin_options._may_find_out", lambda what, error: True)
        assert run(record) == 0
    assert "sends 8 x 13 cells" in capsys.readouterr().err
    with Skin.open("press.mcap") as skin:
        assert skin.read().counts.shape == (8, 13)


@pytest.mark.parametrize(
    ("answer", "looks"),
    [(None, "an echo"), (b"HTTP/1.1 400 Bad Request\r\n\r\n", "a web server"), (bytes(range(1, 60)), "binary such as")],
)
def test_the_message_says_what_bytes_look_like(answer: bytes | None, looks: str) -> None:
    """None: whatever is sent comes back."""
    with PtyPort() as port:
        stop = threading.Event()

        def answers() -> None:
            while not stop.wait(0.01):
                heard = port.read() or b""
                if heard:
                    port.write(heard if answer is None else answer)

        thread = threading.Thread(target=answers)
        thread.start()
        with pytest.raises(OhmskinError, match=looks), Skin.open(port.name, timeout=1.5):
            pass
        stop.set()
        thread.join()


def test_a_modbus_sensor_is_asked_for_its_registers() -> None:
    request = bytes.fromhex("010400070020") + CHECKSUMS["crc16-modbus"].of(bytes.fromhex("010400070020"))
    tables = {
        "board": {"name": "modbus", "rows": 4, "columns": 8, "bits": 12},
        "frame": {
            "format": "binary",
            "block": [{"fields": ["const 0x01 0x04 0x40", "cells uint16be 32", "crc16-modbus"]}],
        },
        "start": {"poll": list(request)},
    }
    with Played(BoardFile.parse(tables, "here").family()) as port:
        found = examine_traffic(port.name, listen_s=0.25, poke=lambda: True).draft
    assert found is not None
    assert found.guess.tables["start"] == {"poll": list(request)}
    assert found.guess.tables["frame"]["checksum"] == "crc16-modbus"


def test_answers_are_frames_though_some_came_later_than_others() -> None:
    """Bytes without a header, each frame an answer: the first ones after longer waits than the others."""
    rng, chunks, at = np.random.default_rng(3), [], 0.0
    row, column = np.mgrid[:16, :16]
    for k in range(20):
        at += 0.3 if k < 3 else 0.1
        hill = np.exp(-((row - 8) ** 2 + (column - 3 - k / 2) ** 2) / 5)
        chunks.append(Chunk(at, (12 + 150 * hill + rng.integers(0, 5, hill.shape)).astype(np.uint8).tobytes()))
    found = draft(chunks, baudrate=9600, poll=b"A")
    assert found is not None
    assert found.guess.tables["frame"]["word"] == "uint8"
    assert found.guess.tables["board"]["rows"] * found.guess.tables["board"]["columns"] == 256


def test_only_ports_with_a_uart_are_tried_at_several_baud_rates(tmp_path: Path) -> None:
    said: list[str] = []
    with PtyPort(tmp_path / "skin") as port:
        assert not any(map(has_baud_rate, (port.name, str(tmp_path / "skin"), "socket://127.0.0.1:9")))
        traffic = examine_traffic(port.name, listen_s=0.1, tell=said.append)
    assert all(map(has_baud_rate, ("/dev/ttyUSB0", "rfc2217://127.0.0.1:9")))
    assert traffic.finding.found == "silent, also when asked in each family's way"
    assert said
    assert all("115200 baud" in text for text in said)


def test_random_bytes_sound_like_no_board() -> None:
    rng = np.random.default_rng(1)
    assert all(judge(rng.bytes(20_000)) is None for _ in range(20))
    noise = [Chunk(0.02 * k, rng.bytes(int(rng.integers(50, 400)))) for k in range(80)]
    assert draft(noise, baudrate=9600) is None


def test_the_exit_code_tells_of_problems(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["doctor", "/dev/no-such-port", "--json"]) == 3
    (missing,) = json.loads(capsys.readouterr().out)
    assert (missing["state"], missing["found"]) == ("problem", "is not there")
    for port, found in (
        ("/dev/no-such-port", "-> plug the board in"),
        ("socket://127.0.0.1:9", "cannot be opened"),
        (__file__, "is a file"),
        (".", "is a folder"),
    ):
        assert run(["doctor", port]) == 3
        assert found in capsys.readouterr().out


# Drafts of boards' formats (:mod:`formats`): none wrong without a question, and time and number taken over


@pytest.mark.parametrize("name", FORMATS)
def test_a_draft_reads_what_was_sent(name: str) -> None:
    one = judged(FORMATS[name], baud=None)
    assert one.outcome in ("right", "asked")
    assert set(one.kept) >= set(FORMATS[name].keeps)
    assert one.found is not None
    assert (one.outcome == "right") or one.found.questions
    assert one.found.rate_hz == pytest.approx(1.0 / FORMATS[name].period_s, rel=0.1)
