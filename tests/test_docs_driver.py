"""The examples of docs/driver.md, run as they are but for the names of ports and the length of loops."""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from boards import scene

from ohmskin.driver import Skin, Tare
from ohmskin.emulator import PtyPort, running

TEXT = (Path(__file__).parents[1] / "docs" / "driver.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
PORT = '"/dev/ttyACM0"'


def test_every_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the page, on boards that are at their end after a while, so that loops end."""
    pytest.importorskip("mcap")
    monkeypatch.chdir(tmp_path)
    assert len(SNIPPETS) == 5
    for number, snippet in enumerate(SNIPPETS):
        board = scene(contact=[], board={"frame_rate": 200.0, "serial_number": "L-07"})
        port, other = PtyPort(), PtyPort()
        second = scene(contact=[], board={"frame_rate": 200.0, "serial_number": "R-02"})
        names = [port.name, other.name]
        monkeypatch.setattr("ohmskin.driver._discover.serial_ports", lambda names=names: names)
        with running(board, port, duration_s=3.0), running(second, other):
            known: dict[str, Any] = {"Skin": Skin, "Tare": Tare}
            if "skin" in snippet and "Skin.open(" not in snippet:
                known["skin"] = Skin.open(port.name)
            try:
                exec(compile(snippet.replace(PORT, repr(port.name)), f"example {number}", "exec"), known)
            finally:
                for name in ("skin", "left", "right"):
                    if name in known:
                        known[name].close()
    with Skin.open("press.mcap") as played:
        assert len(list(islice(played, 10))) == 10
