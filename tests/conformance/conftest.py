"""The board that the conformance tests run against: they know it by its port only."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from boards import DESIGN, EXAMPLES, scene
from needs import need

from ohmskin.emulator import PtyPort, TcpPort, running
from ohmskin.emulator.firmware import missing_for, running_firmware


@pytest.fixture(params=["pty", "tcp", "firmware"])
def port(request: pytest.FixtureRequest) -> Iterator[str]:
    """A board in service, which nobody has open."""
    end = TcpPort.at(":0") if request.param == "tcp" else PtyPort()
    if request.param == "firmware":
        need(missing_for())
        reference_board = {"design": str(EXAMPLES / "board-4x4.toml")}
        board = running_firmware(scene(skin=reference_board, board={"frame_rate": 100.0}, contact=[]), end)
    else:
        big = {"design": DESIGN | {"array": {"rows": 16, "columns": 16}}}
        board = running(scene(skin=big, board={"frame_rate": 100.0, "reference_resistances": [10e3, 20e3]}), end)
    with board:
        yield end.name
