"""End to end: the command, a real pty or TCP port, pyserial, the driver, and the truth beside it."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, scene
from patience import HANG_S

from ohmskin.circuits import adc_codes
from ohmskin.cli import run
from ohmskin.driver import Skin
from ohmskin.emulator import PtyPort, Scene, TcpPort, running
from ohmskin.errors import InputError, LinkError

SCENE = """
[skin]
design = { array = { rows = 4, columns = 3, row_lead = 70.0, column_lead = 0.25 }, drive = { voltage = -1.0 }, \
readout = { circuit = "inverting-amplifier", reference_resistance = 20000.0, supply = [0.0, 3.3] }, \
adc = { bits = 12, range = [0.0, 3.3] } }
[[contact]]
cells = [[2, 1]]
load_kpa = [[0.0, 0.0], [1.0, 0.0], [1.05, 15.5], [6.0, 15.5], [6.05, 0.0]]
[[contact]]
bump = { center = [0.5, 0.5], sigma_cells = 0.5 }
load_kpa = [[0.0, 0.0], [2.0, 0.0], [3.0, 12.0], [7.0, 12.0], [8.0, 0.0]]
"""


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


@contextmanager
def command(*arguments: str | Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """``ohmskin emulate`` in a process of its own, and the port that it prints."""
    process = subprocess.Popen(
        [sys.executable, "-m", "ohmskin", "emulate", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("end", ["pty", "tcp"])
def test_the_frames_are_the_truth_and_the_estimate_is_near_it(scene_file: Path, tmp_path: Path, end: str) -> None:
    """Ten seconds of two contacts at the fast clock: not one frame is lost, and every count is the truth's."""
    truth = tmp_path / "truth.npz"
    where = ["--link", tmp_path / "skin"] if end == "pty" else ["--tcp", ":0"]
    with command(scene_file, *where, "--clock", "fast", "--duration", "10", "--truth", truth) as (process, port):
        with Skin.open(port, delivery="lossless", reconnect=0.0) as skin:
            frames = list(skin)
        assert process.wait(60) == 0
    assert not (tmp_path / "skin").is_symlink()

    design = Scene.load(scene_file).skin.design
    with np.load(truth) as file:
        arrays = dict(file)
    assert len(frames) == 500
    assert sum(frame.lost_before for frame in frames) == 0
    np.testing.assert_array_equal([frame.sequence for frame in frames], arrays["sequence"])
    np.testing.assert_allclose([frame.device_time for frame in frames], arrays["time_s"], rtol=0, atol=1e-9)
    np.testing.assert_array_equal([frame.counts for frame in frames], adc_codes(design, arrays["volts"]))

    estimated = np.array([frame.pressure for frame in frames])
    assert arrays["pressure_kpa"][:, 2, 1].max() > 15.5
    assert np.sqrt(np.mean((estimated - arrays["pressure_kpa"]) ** 2)) < 0.12
    pressed = arrays["pressure_kpa"].max(axis=0) > 1.0
    quiet = estimated[:, arrays["pressure_kpa"].max(axis=0) < 0.01]
    assert pressed.sum() >= 3
    assert np.abs(quiet).max() < 0.1


def test_what_a_host_that_does_not_read_loses_is_counted(tmp_path: Path) -> None:
    """A 16 x 16 skin at 200 Hz fills what driver, kernel and board hold in a quarter of a second."""
    port, truth = PtyPort(), tmp_path / "truth.npz"
    big = scene(skin={"design": DESIGN | {"array": {"rows": 16, "columns": 16}}}, board={"frame_rate": 200.0})
    with running(big, port, truth=truth), Skin.open(port.name, delivery="lossless", queue=1) as skin:
        first = next(skin)
        frames, lost = [], 0
        while lost <= 50:
            time.sleep(0.02)
            frames.append(next(skin))
            lost += frames[-1].lost_before
        frames += [next(skin) for _ in range(30)]
    lost = sum(frame.lost_before for frame in frames)
    assert lost + len(frames) == frames[-1].sequence - first.sequence
    assert any(frame.overrun for frame in frames)
    with np.load(truth) as arrays:
        np.testing.assert_array_equal(arrays["sequence"], np.arange(len(arrays["sequence"])))


def test_a_host_that_only_listens_is_served_at_the_fast_clock_too() -> None:
    """As `cat` would: open, say nothing, read."""
    port = PtyPort()
    with running(scene(), port, clock="fast"):
        fd = os.open(port.name, os.O_RDWR | os.O_NOCTTY)
        try:
            got = b""
            while len(got) < 10_000:
                got += os.read(fd, 4096)
        finally:
            os.close(fd)


def test_a_second_driver_is_turned_away_from_tcp() -> None:
    port = TcpPort.at(":0")
    with running(scene(), port), Skin.open(port.name) as skin:
        with pytest.raises(LinkError, match="the board has gone away"):
            Skin.open(port.name)
        assert next(skin).sequence >= 0


def test_a_board_that_nobody_reads_lives_out_its_time_and_its_seed(scene_file: Path) -> None:
    scene_file.write_text(SCENE + "[board]\nnoise = 0.001\n")
    volts = []
    for seed in ("1", "1", "2"):
        truth = scene_file.with_name("truth.npz")
        assert run(["emulate", str(scene_file), "--duration", "0.3", "--truth", str(truth), "--seed", seed]) == 0
        with np.load(truth) as arrays:
            np.testing.assert_allclose(arrays["time_s"], np.arange(15) / 50)
            volts.append(arrays["volts"])
    np.testing.assert_array_equal(volts[0], volts[1])
    assert (volts[0] != volts[2]).all()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_ends_the_run_with_the_truth_written(
    scene_file: Path, tmp_path: Path, number: signal.Signals, code: int
) -> None:
    truth, link = tmp_path / "truth.npz", tmp_path / "skin"
    with command(scene_file, "--link", link, "--truth", truth) as (process, port):
        with Skin.open(port) as skin:
            seen = [next(skin).sequence for _ in range(10)]
        process.send_signal(number)
        assert process.wait(60) == code
        _, errors = process.communicate()
    assert [line for line in errors.splitlines() if "too slow for the scene" not in line] == []
    assert np.load(truth)["sequence"][seen[-1]] == seen[-1]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["scene.toml", "truth.npz"]


def free_tcp_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@pytest.mark.parametrize(
    ("port", "message"),
    [
        ("/dev/nothing-here", "/dev/nothing-here: no such port; serial ports present: "),
        ("/dev/null", "/dev/null: is no serial port"),
        (__file__, "test_link.py: is no serial port but a file; recordings of ohmskin end in .mcap"),
        ("nonsense://x", "nonsense://x: cannot be opened: invalid URL, protocol 'nonsense' not known"),
        ("socket://127.0.0.1:{free}", "cannot be opened: Connection refused"),
    ],
)
def test_a_port_that_cannot_be_opened_says_why(port: str, message: str) -> None:
    with pytest.raises(LinkError, match=re.escape(message)) as caught:
        Skin.open(port.format(free=free_tcp_port()))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"port": "/dev/nothing-here"}, "no such port"),
        ({"port": "ohmskin://nowhere.toml?clock=fast"}, "no such scene"),
        ({"port": "/dev/nothing-here", "design": "no-such.toml"}, "no-such.toml: cannot be read"),
        ({"cell": "no-such.toml"}, "no-such.toml: cannot be read"),
        ({"calibration": "no-such.toml"}, "no-such.toml: cannot be read"),
        ({"record": "nowhere/press.mcap"}, "nowhere/press.mcap: cannot be written: No such file or directory"),
        ({"record": "."}, "cannot be written: is a directory"),
        ({"record": __file__}, "is there already"),
        ({"estimator": "kalman"}, "no estimator 'kalman'; expected one of static, "),
        ({"accuracy": 1.5}, "accuracy is 1.5; expected"),
        ({"board": "teletype"}, "teletype"),
        ({"baudrate": 0}, "baudrate is 0 bit/s"),
        ({"timeout": -1.0}, "timeout is -1.0 s"),
        ({"delivery": "some"}, "delivery 'some'"),
        ({"timeout": "3"}, "timeout is '3'; expected a number, in s"),
        ({"accuracy": "x"}, "accuracy is 'x'; expected a number"),
        ({"reconnect": None}, "reconnect is None; expected a number, in s"),
        ({"pitch": "4 mm"}, "pitch is '4 mm'; expected a number, in m"),
        ({"baudrate": "fast"}, "baudrate is 'fast'; expected a number, in bit/s"),
        ({"design": 3}, "design is 3; expected a Design or the path of its file"),
        ({"cell": []}, "cell is []; expected a Cell or the path of its file"),
        ({"calibration": 0}, "calibration is 0; expected a Calibration or the path of its file"),
        ({"record": 3}, "name of the recording is 3; expected the path of a file"),
        ({"board": 3}, "board is 3; expected the name of a family"),
        ({"serial_number": 7}, "serial_number is 7; expected text"),
        ({"port": 3}, "port is 3; expected the name of a port or of a recording"),
        ({"port": b"/dev/ttyACM0"}, "expected the name of a port or of a recording"),
        ({"port": Path("/dev/nothing-here")}, "/dev/nothing-here: no such port"),
        ({"queue": 0}, "queue is 0; expected a whole number, at least 1"),
    ],
)
def test_what_is_wrong_with_an_opening_is_told_before_anything_is_compiled(
    options: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compiler that takes ten seconds must not keep whoever mistyped a name waiting."""
    asked: list[object] = []
    monkeypatch.setattr("ohmskin.common.compiled.load", lambda *loops: asked.append(loops))
    with PtyPort() as port, pytest.raises((LinkError, InputError), match=re.escape(message)) as caught:
        Skin.open(**{"port": port.name, **options})
    assert "\n" not in str(caught.value)
    assert not asked


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.toml"], "nowhere.toml: cannot be read: No such file or directory"),
        (["{scene}", "--link", "{tmp}/no/skin"], "no/skin: cannot be linked: No such file or directory"),
        (["{scene}", "--link", "{scene}"], "scene.toml: exists and is no symbolic link"),
        (["{scene}", "--truth", "{tmp}/no/t.npz"], "no/t.npz: cannot be written: No such file or directory"),
        (["{scene}", "--board", "flexitac"], "an ADC of 12 bits; its format carries at most 8"),
        (["{scene}", "--tcp", "4711x"], "'4711x' is no address; expected HOST:PORT or :PORT"),
        (["{scene}", "--tcp", "localhost:70000"], "'localhost:70000' is no address"),
        (["{scene}", "--tcp", "192.0.2.1:1"], "192.0.2.1:1: cannot listen there"),
        (["{scene}", "--link", "{tmp}/a", "--tcp", ":0"], "--link, --tcp and --rfc2217 exclude each other"),
        (["{scene}", "--duration", "-1"], "'-1' is no positive number"),
        (["{scene}", "--duration", "nan"], "Invalid value for '--duration': 'nan' is no positive number"),
        (["{scene}", "--clock", "slow"], "'slow' is not one of 'real', 'fast'"),
        (["{scene}", "--seed", "-3"], "-3 is not in the range x>=0"),
    ],
)
def test_bad_input_of_the_command_is_one_line_and_leaves_nothing(
    arguments: list[str], message: str, scene_file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    places = {"scene": scene_file, "tmp": scene_file.parent}
    assert run(["emulate", *(argument.format(**places) for argument in arguments)]) == 2
    printed, errors = capfd.readouterr()
    assert printed == ""  # no port that a script would open
    assert message in errors
    assert errors.startswith("ohmskin: ")
    assert errors.count("\n") == 1
    assert [file.name for file in scene_file.parent.iterdir()] == ["scene.toml"]


def test_the_driver_example_runs_as_it_is(scene_file: Path, tmp_path: Path) -> None:
    example = Path(__file__).parents[1] / "examples" / "read_skin.py"
    assert len(example.read_text().splitlines()) <= 10
    # At the fast clock the host would find a newest frame or two only; loading its kernels takes a busy machine long.
    with command(scene_file, "--link", tmp_path / "skin", "--clock", "real", "--duration", "30") as (_, port):
        done = subprocess.run(
            [sys.executable, str(example), port], capture_output=True, text=True, timeout=HANG_S, check=False
        )
    assert done.stdout.count("kPa") > 2
    assert (done.returncode, done.stderr) == (0, "")  # the board's time is over: an end, no failure
