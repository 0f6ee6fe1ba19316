"""Emulated boards and their hosts on one machine: which boards there are, and whether a hang-up was an end."""

from __future__ import annotations

import contextlib
import os
import signal
import socketserver
import subprocess
import sys
import termios
import threading
import tty
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from boards import EXAMPLES, scene
from patience import Patience

from ohmskin.common.rendezvous import Announcement, announced, announced_ports
from ohmskin.driver import Frame, Skin, discover
from ohmskin.emulator import Port, PtyPort, Rfc2217Port, Scene, TcpPort, running
from ohmskin.errors import LinkEnded, LinkError
from ohmskin.wire import FramePacket, board_protocol

FINGERS, PROTOTYPE = EXAMPLES / "fingers.toml", EXAMPLES.parent / "verification" / "prototype.toml"
LINKS: dict[str, Callable[[], Port]] = {
    "pty": PtyPort,
    "tcp": lambda: TcpPort.at(":0"),
    "rfc2217": lambda: Rfc2217Port.at(":0"),
}
FOREIGN = (
    "spy://{tty}?file={victim}",
    "spy://{tty}?file={victim}&all",
    "loop://",
    "alt://{tty}?class=VTIMESerial",
    "hwgrep://.*",
    "ohmskin://{scene}?truth={victim}",
    "SPY://{tty}?file={victim}",
    "rfc2217://127.0.0.1:{number}?logging=debug",
    "socket://127.0.0.1:{number}/{victim}",
    "socket://user@127.0.0.1:{number}",
    "socket://192.0.2.1:7000",
    "socket://robot.example:7000",
    "socket://0x7f000001:7000",
    "socket:// 127.0.0.1:7000",
    "{victim}",
    "/dev/null",
    "/dev/../{victim}",
    "/dev/pts/../../{victim}",
    "/dev/pts/0\0{victim}",
    "/dev/ttyS0\x1b[2J",
    "dev/pts/0",
    "/dev/pts/ptmx",
)
"""names that stand in notes for no port of this machine: of the port {tty}, the TCP port {number}, a file"""


@pytest.fixture(autouse=True)
def _no_real_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("serial.tools.list_ports.comports", list)


def files() -> list[Path]:
    return list(Path(os.environ["OHMSKIN_RUNTIME_DIR"]).glob("*"))


def silent_board(port: Port, duration_s: float = 1.0, clock: str = "fast"):  # type: ignore[no-untyped-def]
    """A board of a family that has no packet for its end."""
    return running(Scene.load(FINGERS), port, clock=clock, duration_s=duration_s, family="fsr-array")  # type: ignore[arg-type]


def host_of(port: Port, reconnect: float = 30.0) -> Skin:
    return Skin.open(
        port.name, board="fsr-array", design=PROTOTYPE, delivery="lossless", timeout=30.0, reconnect=reconnect
    )


class TestEnds:
    @pytest.mark.parametrize("link", LINKS)
    def test_the_end_of_a_family_without_an_end_packet_is_an_end(self, link: str) -> None:
        port = LINKS[link]()
        with silent_board(port), host_of(port) as skin:
            assert len(list(skin)) == 50
            with pytest.raises(LinkEnded, match="the emulated board has come to the end of its time"):
                skin.read()
            assert skin.stats().reconnects == 0

    def test_a_program_that_is_killed_is_gone(self, tmp_path: Path) -> None:
        words = [sys.executable, "-m", "ohmskin", "emulate", str(FINGERS), "--board", "fsr-array", "--clock", "fast"]
        emulator = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        try:
            assert emulator.stdout is not None
            name = emulator.stdout.readline().strip()
            with Skin.open(name, board="fsr-array", design=PROTOTYPE, timeout=30.0, reconnect=0.2) as skin:
                next(skin)
                emulator.send_signal(signal.SIGKILL)
                with pytest.raises(LinkError, match=r"it has not come back within 0\.2 s") as caught:
                    list(skin)
                assert not isinstance(caught.value, LinkEnded)
        finally:
            emulator.kill()
            emulator.communicate()
        assert list(announced_ports()) == []
        assert files() == []

    @pytest.mark.parametrize("link", ["pty", "tcp"])
    def test_an_emulator_that_was_started_again_is_found_at_its_new_port(self, link: str) -> None:
        """Its number, or TCP port, is another one; boards with other serial numbers appear beside it."""
        mine, other = (scene(board={"serial_number": name, "frame_rate": 100.0}) for name in ("A1", "B2"))
        old = LINKS[link]()
        with contextlib.ExitStack() as boards:
            boards.enter_context(running(other, LINKS[link]()))  # there all the time
            with running(mine, old):
                skin = boards.enter_context(Skin.open(old.name, reconnect=200.0))
                rest = skin.tare(5, force=True)
                next(skin)
                boards.enter_context(running(other, LINKS[link]()))
                new = LINKS[link]()  # while the old one has its number
            assert new.name != old.name
            boards.enter_context(running(mine, new))
            back = next(frame for frame in skin if frame.reconnected)
            assert (back.rebooted, skin.serial_number, skin.tared) == (True, "A1", rest)
            assert skin.stats().reconnects == 1

    def test_a_board_that_is_plugged_in_again_is_found_under_its_new_number(self) -> None:
        """Another program gets the number of its pseudo-terminal meanwhile."""
        pulled = {"kind": "unplug", "at_s": 2.0, "duration_s": 1.0}
        port, patience = PtyPort(), Patience()
        with contextlib.ExitStack() as ends:
            ends.enter_context(running(scene(board={"frame_rate": 100.0}, link_fault=[pulled]), port))
            skin = ends.enter_context(Skin.open(port.name, reconnect=60.0, timeout=30.0))
            old_name = port.name
            while os.path.exists(old_name):
                patience.spend(f"{old_name} to go away")
            names = [""]
            while names[-1] != old_name and len(names) < 8:  # a test beside this one may take it
                master, other = os.openpty()
                names.append(os.ttyname(other))
                tty.setraw(other, termios.TCSANOW)
                ends.callback(os.close, master)
                ends.callback(os.close, other)
            os.write(master, b"for somebody else")
            back = next(frame for frame in skin if frame.reconnected)
            assert back.rebooted
            assert port.name not in names
            assert os.read(other, 100) == b"for somebody else"

    def test_a_bridge_that_hangs_up_and_goes_on_listening_is_no_end(self) -> None:
        """As a bridge from TCP to a serial port does when the cable behind it is pulled."""
        some = FramePacket.of(np.full((4, 4), 900), sequence=0, time_us=0)
        said = [3 * board_protocol("fsr-array", shape=(4, 4), adc_bits=12).frame(some)]
        taken = threading.Event()

        class Bridge(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                if said:
                    self.request.sendall(said.pop())
                    taken.wait(60)

        with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Bridge) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            name = "socket://{}:{}".format(*server.server_address)
            with Skin.open(name, board="fsr-array", design=PROTOTYPE, delivery="lossless", reconnect=0.5) as skin:
                next(skin)
                taken.set()
                with pytest.raises(LinkError, match="the other end hung up") as caught:
                    list(skin)
                assert not isinstance(caught.value, LinkEnded)
            server.shutdown()

    def test_the_end_of_a_recording_without_an_end_packet_is_an_end(self, tmp_path: Path) -> None:
        path, link = tmp_path / "cut.mcap", tmp_path / "skin"
        port = PtyPort()
        with (
            running(scene(board={"frame_rate": 200.0}), port),
            Skin.open(port.name, delivery="every", record=path, timeout=30.0) as skin,
        ):
            count = len(list(islice(skin, 40)))
        player = subprocess.Popen(
            [sys.executable, "-m", "ohmskin", "replay", str(path), "--link", str(link), "--speed", "50"],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert player.stdout is not None
            player.stdout.readline()
            assert discover() == []  # would play the recording
            with Skin.open(str(link), delivery="lossless", reconnect=60.0, timeout=30.0) as skin:
                assert len(list(skin)) >= count
                with pytest.raises(LinkEnded):
                    skin.read()
            assert player.wait(30) == 0
        finally:
            player.kill()
            player.communicate()


class TestOtherMachines:
    """Boards without a note on this machine, over plain TCP: what the connection itself tells."""

    @pytest.fixture
    def elsewhere(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], None]:
        """Boards that have announced themselves until this is called are not known here."""
        return lambda: monkeypatch.setenv("OHMSKIN_RUNTIME_DIR", str(tmp_path / "here"))

    @pytest.mark.parametrize("reconnect", [0.0, 1e6])
    def test_the_regular_end_is_sent_by_urgent_data(self, elsewhere: Callable[[], None], reconnect: float) -> None:
        """At once: who waited until it is clear that nobody listens any more would wait for ten days here."""
        port = TcpPort.at(":0")
        elsewhere()
        with silent_board(port), host_of(port, reconnect) as skin:
            assert len(list(skin)) == 50
            with pytest.raises(LinkEnded, match="the emulated board has come to the end of its time"):
                skin.read()

    @pytest.mark.parametrize("link", ["tcp", "rfc2217"])
    def test_where_nothing_says_that_it_was_the_end_the_board_has_gone(
        self, elsewhere: Callable[[], None], monkeypatch: pytest.MonkeyPatch, link: str
    ) -> None:
        """Behind forwarders such as SSH, which drop urgent data, and over RFC 2217."""
        monkeypatch.setattr(TcpPort, "_say_over", lambda *_: None)
        port, taken = LINKS[link](), list[Frame]()
        elsewhere()
        with silent_board(port), host_of(port, reconnect=0.2) as skin:
            with pytest.raises(LinkError, match=r"it has not come back within 0\.2 s") as caught:
                taken.extend(skin)
            assert not isinstance(caught.value, LinkEnded)
        assert len(taken) == 50

    def test_a_program_that_is_killed_is_gone(self, tmp_path: Path) -> None:
        words = ["emulate", str(FINGERS), "--board", "fsr-array", "--tcp", ":0"]
        emulator = subprocess.Popen(
            [sys.executable, "-m", "ohmskin", *words],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OHMSKIN_RUNTIME_DIR": str(tmp_path)},
        )
        try:
            assert emulator.stdout is not None
            name = emulator.stdout.readline().strip()
            with Skin.open(name, board="fsr-array", design=PROTOTYPE, reconnect=0.5) as skin:
                next(skin)
                emulator.kill()
                with pytest.raises(LinkError, match=r"Connection reset by peer\); it has not come back") as caught:
                    list(skin)
                assert not isinstance(caught.value, LinkEnded)
        finally:
            emulator.kill()
            emulator.communicate()


class TestBoards:
    def test_emulated_boards_are_found_and_opened_by_serial_number(self, tmp_path: Path) -> None:
        left, right = PtyPort(tmp_path / "arm"), TcpPort.at(":0")
        with (
            running(scene(board={"serial_number": "L-07"}), left),
            running(scene(board={"serial_number": "R-02"}), right),
        ):
            assert [(board.serial_number, board.port) for board in discover()] == [
                ("L-07", str(tmp_path / "arm")),
                ("R-02", right.name),
            ]
            said = f"nowhere: no such port; serial ports present: .*; emulated boards: .*{left.name}"
            with pytest.raises(LinkError, match=said):
                Skin.open("nowhere")
            with Skin.open(serial_number="L-07") as one, Skin.open(serial_number="R-02") as other:
                assert (one.read(30.0).sequence is None, other.read(30.0).sequence is None) == (False, False)
                assert discover() == []  # both are in use
            there = "no board with serial number middle at a port that is free; boards present: L-07 at .*, R-02 at "
            with pytest.raises(LinkError, match=there):
                Skin.open(serial_number="middle")
            with pytest.raises(LinkError, match="board L-07 is there; expected R-02"):
                Skin.open(str(tmp_path / "arm"), serial_number="R-02")
        assert files() == []
        assert discover() == []

    def test_looking_for_boards_spends_no_time_of_a_board_at_the_fast_clock(self) -> None:
        port = PtyPort()
        with running(scene(), port, clock="fast", duration_s=1.0):
            assert [board.port for board in discover()] == [port.name]
            with Skin.open(port.name, delivery="lossless", timeout=30.0) as skin:
                first = next(skin)
        assert (first.sequence, first.lost_before) == (0, 0)


class TestFiles:
    def test_a_file_that_a_dead_emulator_left_is_removed(self) -> None:
        there = Announcement("/dev/pts/1000")
        left = files()[0].with_name("0-dead.port")
        left.write_text("/dev/pts/1001")
        assert [port.name for port in announced_ports()] == ["/dev/pts/1000"]
        assert not left.exists()
        there.close()
        there.close()
        assert files() == []


class TestForeignNotes:
    """What another user, or a program gone wrong, could put where boards are announced: nothing of it is opened."""

    @pytest.fixture
    def meeting_place(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
        monkeypatch.delenv("OHMSKIN_RUNTIME_DIR")
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        return tmp_path / "ohmskin"

    def test_a_note_that_names_no_port_of_this_machine_is_not_followed(self, tmp_path: Path) -> None:
        victim, listening = tmp_path / "victim", TcpPort.at(":0")
        victim.write_text("precious")
        with PtyPort() as port, listening, contextlib.ExitStack() as notes:
            number = listening.name.rpartition(":")[2]
            for name in FOREIGN:
                said = name.format(tty=port.name, victim=victim, scene=FINGERS.resolve(), number=number)
                notes.callback(Announcement(said).close)
            assert len(files()) == len(FOREIGN) + 2
            assert {found.name for found in announced_ports()} == {port.name, listening.name}
            assert discover(timeout=0.1) == []
            with pytest.raises(LinkError, match="no board with serial number EMU"):
                Skin.open(serial_number="EMU", timeout=0.1)
        assert victim.read_text() == "precious"

    @pytest.mark.parametrize("mode", [0o701, 0o710, 0o740, 0o755, 0o777, 0o1777])
    def test_a_folder_that_is_open_to_others_is_as_if_it_were_not_there(self, meeting_place: Path, mode: int) -> None:
        with PtyPort() as port:
            assert [found.name for found in announced_ports()] == [port.name]
            meeting_place.chmod(mode)
            assert list(announced_ports()) == []
            assert announced(port.name) is None
            with PtyPort() as elsewhere:  # announces itself in the other place
                assert [found.name for found in announced_ports()] == [elsewhere.name]
        meeting_place.chmod(0o700)
        assert list(announced_ports()) == []

    def test_a_note_that_changes_while_a_host_holds_it_is_not_followed_either(self) -> None:
        """Reconnection asks the same note again for the present name of the port."""
        there = Announcement("/dev/pts/1000")
        held = announced("/dev/pts/1000")
        assert held is not None
        there.move("spy:///dev/null?file=/tmp/victim")
        assert (held.name, held.is_listed) == ("", False)
        there.move("/dev/pts/1001")
        assert held.name == "/dev/pts/1001"
        there.close()

    def test_a_link_or_a_pipe_in_place_of_a_note_or_of_the_folder_is_none(self, meeting_place: Path) -> None:
        there = Announcement("/dev/pts/1000")
        (note,) = meeting_place.iterdir()
        moved = meeting_place.rename(meeting_place.with_name("moved"))
        meeting_place.symlink_to(moved)
        assert list(announced_ports()) == []
        meeting_place.unlink()
        moved.rename(meeting_place)
        assert [found.name for found in announced_ports()] == ["/dev/pts/1000"]
        note.rename(note.with_suffix(".moved"))
        note.symlink_to(note.with_suffix(".moved"))
        os.mkfifo(note.with_name("pipe.port"))
        note.with_name("folder.port").mkdir()
        assert list(announced_ports()) == []
        there.close()

    @pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
    def test_a_folder_or_a_note_of_another_user_is_as_if_it_were_not_there(self, meeting_place: Path) -> None:
        there = Announcement("/dev/pts/1000")
        (note,) = meeting_place.iterdir()
        for foreign in (note, meeting_place, meeting_place.parent):  # the last: of another user's login
            os.chown(foreign, 65534, 65534)
            assert list(announced_ports()) == []
            assert note.exists()
            os.chown(foreign, 0, 0)
            assert [found.name for found in announced_ports()] == ["/dev/pts/1000"]
        there.close()

    def test_boards_at_all_addresses_are_announced_at_the_loopback(self) -> None:
        with TcpPort.at("0.0.0.0:0") as port:
            number = port.name.rpartition(":")[2]
            assert [found.name for found in announced_ports()] == [f"socket://127.0.0.1:{number}"]
            for name in (port.name, f"socket://localhost:{number}"):
                assert announced(name) is not None
