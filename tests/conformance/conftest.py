"""The board that the conformance tests run against: they know it by its port only."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from boards import DESIGN, scene

from ohmskin.emulator import PtyPort, TcpPort, running


@pytest.fixture(params=["pty", "tcp"])
def port(request: pytest.FixtureRequest) -> Iterator[str]:
    """A board in service, which nobody has open."""
    end = PtyPort() if request.param == "pty" else TcpPort.at(":0")
    big = DESIGN | {"array": {"rows": 16, "columns": 16}}
    with running(scene(skin={"design": big}, board={"frame_rate": 100.0, "reference_resistances": [10e3, 20e3]}), end):
        yield end.name
