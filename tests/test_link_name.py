"""The symbolic link of an emulator: one owner at a time, taken over from a dead one, never from another program."""

from __future__ import annotations

import os
import pty
from pathlib import Path

import pytest
from boards import scene

from ohmskin.emulator import PtyPort, running
from ohmskin.errors import InputError


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
