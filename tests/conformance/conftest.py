"""The board that the conformance tests run against: they know it by its port only."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import tomli_w
from boards import DESIGN, EXAMPLES, PRESS, scene
from needs import need

from ohmskin.emulator import Port, PtyPort, Rfc2217Port, TcpPort, running
from ohmskin.emulator.firmware import missing_for
from ohmskin.hil.plugin import target

BOARD = {"frame_rate": 100.0, "reference_resistances": [10e3, 20e3]}
SKIN = {"design": DESIGN | {"array": {"rows": 16, "columns": 16}}}
LINKS = ("pty", "tcp", "rfc2217", "in-process", "firmware")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """The emulated board on every kind of link; with ``--ohmskin-target`` the board that it names instead."""
    if "port" in metafunc.fixturenames:
        asked = target(metafunc.config)
        metafunc.parametrize("port", LINKS if asked == "emulated" else [asked], indirect=True)


@pytest.fixture
def port(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """The name of a board in service, which nobody has open."""
    if request.param not in LINKS:
        yield request.getfixturevalue("board").port
        return
    if request.param == "in-process":
        file = tmp_path / "scene.toml"
        file.write_text(tomli_w.dumps({"skin": SKIN, "board": BOARD, "contact": [PRESS]}))
        yield f"ohmskin://{file}"
        return
    if request.param == "firmware":
        need(missing_for())
        reference_board = scene(
            skin={"design": str(EXAMPLES / "board-4x4.toml")}, board={"frame_rate": 100.0}, contact=[]
        )
        with PtyPort() as end, running(reference_board, end, engine="firmware"):
            yield end.name
        return
    match request.param:
        case "pty":
            end: Port = PtyPort()
        case "tcp":
            end = TcpPort.at(":0")
        case _:
            end = Rfc2217Port.at(":0")
    with running(scene(skin=SKIN, board=BOARD), end):
        yield end.name
