"""TCP, RFC 2217 and in-process links of the emulator, and hosts that misbehave on them."""

from __future__ import annotations

import os
import pty
import resource
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from itertools import islice
from pathlib import Path

import pytest
import serial
import tomli_w
from boards import DESIGN, PRESS, scene
from click.testing import CliRunner
from patience import HANG_S, Patience

from ohmskin.bench import soak
from ohmskin.driver import Skin
from ohmskin.emulator import DEMO, PtyPort, Rfc2217Port, Scene, TcpPort, running
from ohmskin.errors import InputError
from ohmskin.wire import Corrupt, Event, FramePacket, Identity, Order, host_protocol


def read_until(line: serial.SerialBase | socket.socket, wanted: type, count: int = 1, timeout_s: float = 60.0) -> list:  # type: ignore[type-arg]
    """Events of one kind from a serial port or a socket."""
    host, found, patience = host_protocol("ohmskin"), [], Patience(timeout_s)
    while len(found) < count:
        patience.spend(f"{len(found)} of {count} {wanted.__name__}")
        data = line.recv(4096) if isinstance(line, socket.socket) else line.read(512)
        if isinstance(line, socket.socket) and not data:
            raise ConnectionResetError("hung up on")
        found += [event for event in host.feed(data, 0.0) if isinstance(event, wanted)]
    return found


def connect(port: TcpPort) -> socket.socket:
    address = port.name.partition("://")[2].rsplit(":", 1)
    return socket.create_connection((address[0], int(address[1])), timeout=HANG_S)


# RFC 2217


def test_an_rfc2217_host_sets_the_baud_rate_and_the_control_lines() -> None:
    port = Rfc2217Port.at(":0")
    with running(scene(), port), serial.serial_for_url(port.name, 250_000, timeout=0.2) as line:
        assert read_until(line, FramePacket)
        assert port.control.baudrate == 250_000
        assert port.control.dtr
        line.dtr = False
        line.rts = False
        line.baudrate = 115_200
        patience = Patience()
        while (port.control.dtr, port.control.rts, port.control.baudrate) != (False, False, 115_200):
            patience.spend()
            line.read(100)


def test_a_host_at_another_baud_rate_than_the_board_hears_noise() -> None:
    """Where the scene's line has a baud rate, and the port shows that of the host."""
    port = Rfc2217Port.at(":0")
    what = scene(line={"baud_rate": 250_000})
    with running(what, port), serial.serial_for_url(port.name, 115_200, timeout=0.2) as line:
        host, events = host_protocol("ohmskin"), list[Event]()
        while len(events) < 20:
            events += host.feed(line.read(200), 0.0)
        assert all(isinstance(event, Corrupt) for event in events)
        line.baudrate = 250_000
        assert read_until(line, FramePacket, 3)


def test_bytes_of_255_come_through_telnet(tmp_path: Path) -> None:
    """Every count and its low byte at 255, which Telnet doubles on the line."""
    port = Rfc2217Port.at(":0")
    full = {**DESIGN, "adc": {"bits": 8, "range": [-9.0, -8.0]}}
    with running(scene(skin={"design": full}), port), serial.serial_for_url(port.name, timeout=0.2) as line:
        for frame in read_until(line, FramePacket, 5):
            assert (frame.counts == 255).all()


def test_a_host_that_raises_dtr_resets_a_board_that_has_auto_reset() -> None:
    port = Rfc2217Port.at(":0")
    what = scene(line={"auto_reset": True}, board={"frame_rate": 200.0})
    with running(what, port), serial.serial_for_url(port.name, timeout=0.2) as line:
        before = read_until(line, FramePacket, 5)[-1]
        line.dtr = False
        line.dtr = True
        patience = Patience()
        while True:
            after = read_until(line, FramePacket)[-1]
            patience.spend()
            if after.boot_id != before.boot_id:
                break
        assert (after.boot_id - before.boot_id) % 2**32 < 5


def test_a_host_that_asks_and_does_not_read_is_hung_up_on_with_a_reason() -> None:
    """Answers of Telnet's negotiation wait in bounded memory, whatever the kernel's buffers hold."""
    port = Rfc2217Port.at(":0")
    with running(scene(), port):
        with connect(port) as deaf, pytest.raises(ConnectionError):
            deaf.sendall(20_000_000 * b"\xff\xfd\x63")  # DO, of an option that nobody has
        assert list(port.hung_up) == ["it asks and does not read: more than 65536 bytes of answers wait"]
        with serial.serial_for_url(f"{port.name}?timeout={HANG_S}", timeout=0.2) as line:
            assert read_until(line, FramePacket)


def test_a_host_that_breaks_telnet_is_hung_up_on_and_the_next_one_served() -> None:
    """A suboption without end, and one that is too short."""
    for attack in (b"\xff\xfa\x2c" + b"x" * 5000, b"\xff\xfa\x2c\x01\xff\xf0", b"\xff\xfa\x2c\x03\x63\xff\xf0"):
        port = Rfc2217Port.at(":0")
        with running(scene(), port):
            with connect(port) as rude:
                rude.sendall(attack)
                rude.settimeout(20)
                with suppress(ConnectionResetError):
                    while rude.recv(4096):
                        pass
            with serial.serial_for_url(port.name, timeout=0.2) as line:
                assert read_until(line, FramePacket, 3)


# In the same process


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    file = tmp_path / "scene.toml"
    file.write_text(tomli_w.dumps({"skin": {"design": DESIGN}, "contact": [PRESS]}))
    return file


def test_a_url_opens_a_board_in_this_process(scene_file: Path) -> None:
    with serial.serial_for_url(f"ohmskin://{scene_file}?clock=fast&duration=1", timeout=0.5) as line:
        assert [frame.sequence for frame in read_until(line, FramePacket, 50)] == list(range(50))


def test_the_shipped_scene_leaves_five_seconds_for_a_tare_and_is_then_pressed() -> None:
    with serial.serial_for_url("ohmskin://demo?clock=fast&duration=0.5", timeout=5.0) as line:
        first = read_until(line, FramePacket, 1)[0]
        assert line.in_waiting > 0
    assert first.counts.shape == (16, 16)
    scene = Scene.load(DEMO)
    assert not any(scene.pressure_kpa(k / 10.0).any() for k in range(50))
    assert all(scene.pressure_kpa(k / 10.0).max() > 1.0 for k in range(53, 130))


def test_the_driver_reads_such_a_url_without_more_ado(scene_file: Path) -> None:
    """In a new interpreter, which has imported the driver only."""
    program = (
        "import sys; from ohmskin.driver import Skin\n"
        "with Skin.open(sys.argv[1]) as skin: print(next(iter(skin)).pressure.shape)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, f"ohmskin://{scene_file}"], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "(3, 2)"


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("ohmskin:///no/scene.toml", "/no/scene.toml: cannot be read"),
        ("ohmskin://{scene}?clock=slow", "clock is 'slow'; expected 'real' or 'fast'"),
        ("ohmskin://{scene}?speed=1", "unknown option 'speed'; expected one of board, clock"),
        ("ohmskin://{scene}?seed=x", "expected numbers for duration, part and seed"),
    ],
)
def test_a_url_that_is_wrong_says_how(scene_file: Path, url: str, message: str) -> None:
    with pytest.raises(serial.SerialException, match=message):
        serial.serial_for_url(url.format(scene=scene_file))


# Hosts that misbehave


@pytest.mark.slow
def test_frames_and_hosts_without_end_leave_nothing_behind(scene_file: Path) -> None:
    """A bounded run of what ``python -m ohmskin.bench.soak`` does with many more frames and two thousand hosts."""
    ran = CliRunner().invoke(soak.main, [str(scene_file), "--frames", "600", "--hosts", "120"])
    assert ran.exit_code == 0, ran.output
    lines = ran.output.splitlines()
    assert lines[0].startswith("600 frames arrived, 0 missing or corrupt")
    assert lines[1].startswith("120 hosts came and went, 40 of them were sent something, 0 files")


def test_unplugging_hangs_up_on_the_host_and_plugging_in_serves_it_again() -> None:
    what = scene(
        link_fault=[{"kind": "unplug", "at_s": 2.5, "duration_s": 0.3}],
        board={"frame_rate": 100.0, "serial_number": "U7"},
    )
    port = TcpPort.at(":0")
    with running(what, port):
        with connect(port) as first:
            first.sendall(host_protocol("ohmskin").request(Order.IDENTIFY))
            boot = read_until(first, Identity)[0].boot_id
            with suppress(ConnectionResetError):
                while first.recv(4096):
                    pass
        patience = Patience()
        while True:
            patience.spend()
            try:
                with connect(port) as second:
                    identity = read_until(second, Identity)[0]
                break
            except ConnectionError:  # the cable is still out
                time.sleep(0.02)
        assert (identity.serial_number, identity.boot_id) == ("U7", (boot + 1) % 2**32)


def test_the_driver_survives_the_example_of_a_bad_link(tmp_path: Path) -> None:
    """A minute of the example at the fast clock, with everything that it has in store, counted by the driver."""
    example = Path(__file__).parents[1] / "examples" / "bad_link.toml"
    what = Scene.load(example)
    assert {fault.kind for fault in what.link_fault} == {"dropped-bytes", "stall", "reset", "unplug"}
    with (
        running(what, PtyPort(tmp_path / "skin"), clock="fast", duration_s=60.0),
        Skin.open(str(tmp_path / "skin"), timeout=60.0) as skin,
    ):
        assert [frame.pressure.shape for frame in skin]
        statistics = skin.stats()
    assert statistics.frames > 3000
    assert statistics.corrupt > 0
    assert statistics.reconnects == 1
    assert statistics.reboots == 2


@pytest.mark.slow
def test_a_host_that_never_reads_gives_way_to_one_that_knocks() -> None:
    port = TcpPort.at(":0")
    what = scene(skin={"design": DESIGN | {"array": {"rows": 32, "columns": 32}}}, board={"frame_rate": 500.0})
    with running(what, port), connect(port) as deaf:
        assert read_until(deaf, FramePacket)
        patience = Patience()
        while True:
            patience.spend()
            with connect(port) as next_host:
                try:
                    if read_until(next_host, FramePacket, timeout_s=0.3):
                        break
                except (AssertionError, ConnectionError):
                    time.sleep(0.1)


def test_more_than_1024_open_files_are_no_obstacle() -> None:
    """``select()`` fails beyond file descriptor 1023; emulator and driver do not use it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 1400:
        pytest.skip(f"at most {hard} files may be open here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 1400), hard))
    with ExitStack() as files:
        files.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        for _ in range(1100):
            files.callback(os.close, os.open(os.devnull, os.O_RDONLY))
        for port in (PtyPort(), TcpPort.at(":0")):
            with running(scene(), port), Skin.open(port.name) as skin:
                assert len(list(islice(skin, 3))) == 3


# The symbolic link of an emulator: one owner at a time, taken over from a dead one, never from another program


def test_a_stale_link_is_replaced_and_everything_is_tidied_up(tmp_path: Path) -> None:
    link = tmp_path / "skin"
    link.symlink_to("/dev/pts/nobody")
    with PtyPort(link) as port:
        assert link.resolve() == Path(os.path.realpath(port.name))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("make", ["file", "directory", "link to a file", "link to nothing", "link to a terminal"])
def test_what_no_emulator_made_is_left_alone(tmp_path: Path, make: str) -> None:
    link, target = tmp_path / "skin", tmp_path / "precious"
    master, other = pty.openpty()
    match make:
        case "file":
            link.write_text("precious")
        case "directory":
            link.mkdir()
        case "link to a file":
            target.write_text("precious")
            link.symlink_to(target)
        case "link to nothing":
            link.symlink_to(target)
        case _:
            link.symlink_to(os.ttyname(other))
    before = sorted((file.name, file.is_symlink() and os.readlink(file)) for file in tmp_path.iterdir())
    with pytest.raises(InputError, match="expected a free name"):
        PtyPort(link)
    assert sorted((file.name, file.is_symlink() and os.readlink(file)) for file in tmp_path.iterdir()) == before
    os.close(master)
    os.close(other)


def test_a_name_has_one_owner_at_a_time(tmp_path: Path) -> None:
    link = tmp_path / "skin"
    with PtyPort(link) as first:
        with pytest.raises(InputError, match="in use, perhaps by another emulator"):
            PtyPort(link)
        assert link.resolve() == Path(os.path.realpath(first.name))
    with PtyPort(link):
        assert link.is_symlink()


def test_a_cable_that_is_pulled_takes_the_link_away_and_brings_it_back_under_another_name(tmp_path: Path) -> None:
    faults = [{"kind": "unplug", "at_s": 0.3, "duration_s": 0.3, "name": "skin2"}]
    link, other = tmp_path / "skin", tmp_path / "skin2"
    seen = set()
    with running(scene(link_fault=faults, board={"frame_rate": 100.0}), PtyPort(link)):
        while not other.is_symlink():
            seen.add(link.is_symlink())
        assert not link.is_symlink()
    assert True in seen
    assert not list(tmp_path.iterdir())
