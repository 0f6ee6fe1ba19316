"""The symbolic link of an emulator: owned by one living process, taken over from a dead one, never from a stranger."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from boards import scene
from patience import HANG_S

from ohmskin.emulator import PtyPort, running
from ohmskin.errors import InputError

SCENE = """
[skin]
design = { array = { rows = 2, columns = 2 }, drive = { voltage = -1.0 }, \
readout = { circuit = "inverting-amplifier", reference_resistance = 20000.0 }, adc = { bits = 12, range = [0.0, 3.3] } }
"""


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


def start(scene_file: Path, link: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "ohmskin", "emulate", str(scene_file), "--link", str(link)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


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
        with pytest.raises(InputError, match="in use by another emulator"):
            PtyPort(link)
        assert link.resolve() == Path(os.path.realpath(first.name))
    with PtyPort(link):
        assert link.is_symlink()


def test_a_link_that_leads_elsewhere_by_now_is_not_removed(tmp_path: Path) -> None:
    link = tmp_path / "skin"
    with PtyPort(link):
        link.unlink()
        link.symlink_to(tmp_path)
    assert link.resolve() == tmp_path


def test_the_link_of_a_killed_emulator_is_taken_over_even_when_its_terminal_is_in_use_again(
    scene_file: Path, tmp_path: Path
) -> None:
    link = tmp_path / "skin"
    killed = start(scene_file, link)
    assert killed.stdout is not None
    assert killed.stdout.readline().strip() == str(link)
    device = os.readlink(link)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    # Strangers open pseudo-terminals until one of them has the dead emulator's number.
    strangers = []
    while not os.path.exists(device) and len(strangers) < 500:
        strangers.append(pty.openpty())
    try:
        assert os.path.exists(device)
        with PtyPort(link) as port:
            assert os.readlink(link) != device
            assert port.name == str(link)
    finally:
        for pair in strangers:
            for end in pair:
                os.close(end)


def test_of_emulators_that_race_for_a_name_exactly_one_gets_it(scene_file: Path, tmp_path: Path) -> None:
    link = tmp_path / "skin"
    racers = [start(scene_file, link) for _ in range(4)]
    try:
        first_lines = []
        for racer in racers:
            assert racer.stdout is not None
            first_lines.append(racer.stdout.readline().strip())
        assert sorted(first_lines) == ["", "", "", str(link)]
        winner = racers[first_lines.index(str(link))]
        losers = [racer for racer in racers if racer is not winner]
        for loser in losers:
            _, errors = loser.communicate(timeout=HANG_S)
            assert loser.returncode == 2
            assert errors.count("\n") == 1
            assert "in use by another emulator" in errors
        assert winner.poll() is None
        winner.send_signal(signal.SIGHUP)
        assert winner.wait(30) == 128 + signal.SIGHUP
    finally:
        for racer in racers:
            racer.kill()
            racer.communicate()
    assert [file.name for file in tmp_path.iterdir()] == ["scene.toml"]


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
