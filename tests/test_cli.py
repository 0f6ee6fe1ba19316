"""The command line as a newcomer meets it: what it prints, and one clear line when something is wrong."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import numpy as np
import pytest

from ohmskin.circuits import Design, effects, scan
from ohmskin.cli import COMMANDS, ohmskin, run
from ohmskin.cli._bar import progress_bar

DESIGN = """
[array]
rows = 2
columns = 3
row_lead = 70.0
[drive]
voltage = -1.0
[readout]
circuit = "inverting-amplifier"
reference_resistance = 1000.0
"""
CELLS = "1e4, 2e4, inf\n1e4,1e4,5e3\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "design.toml").write_text(DESIGN)
    (tmp_path / "cells.csv").write_text(CELLS)
    return tmp_path


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {name} " in shown for name in COMMANDS)
    assert run(["--version"]) == 0
    assert "ohmskin" in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([name, "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"ohmskin {name}" in shown
    examples = [line.split() for line in shown.partition("Example")[2].splitlines()[1:]]
    assert examples
    for words in examples:
        assert words[:2] == ["ohmskin", name]
        assert _parsed(words[1:]).command.name == "command"


def _parsed(words: list[str]) -> click.Context:
    """The context in which click would call the command."""
    with ohmskin.make_context("ohmskin", list(words)) as context:
        found = ohmskin.get_command(context, words[0])
        assert found is not None
        return found.make_context("command", words[1:])


def test_scan_prints_and_writes_what_the_library_computes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cells = np.array([[1e4, 2e4, np.inf], [1e4, 1e4, 5e3]])
    expected = scan(Design.load("design.toml"), cells)
    assert run(["scan", "design.toml", "--cells", "cells.csv", "-o", "out.csv", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["volts"] == expected.volts.tolist()
    assert printed["resistance"][0][2] is None
    assert printed["method"] == expected.method
    assert 0 <= printed["error_bound"] < 1e-9
    assert printed["saturated"] == [[False] * 3] * 2
    assert printed["seconds"] > 0
    assert np.array_equal(np.loadtxt("out.csv", delimiter=","), expected.resistance)


BAD = {  # what is wrong: (replaced in design.toml, by, what the message names)
    "missing key": ("rows = 2", "", ["design.toml", "array.rows"]),
    "missing section": ("[drive]\nvoltage = -1.0", "", ["design.toml", "drive"]),
    "unknown key": ("rows = 2", "rows = 2\nrow_laed = 3.0", ["array.row_laed", "'row_lead'"]),
    "slip of the pen": ("rows = 2", "rwos = 2", ["array.rwos", "'rows'"]),
    "unknown section": ("[drive]", "[drvie]", ["drvie", "'drive'"]),
    "text for a number": ("1000.0", '"1 kOhm"', ["readout.reference_resistance", "1 kOhm"]),
    "NaN": ("70.0", "nan", ["array.row_lead", "nan"]),
    "negative": ("70.0", "-70.0", ["array.row_lead", "-70"]),
    "infinite lead": ("70.0", "inf", ["array.row_lead", "inf"]),
    "no rows": ("rows = 2", "rows = 0", ["array.rows", "0"]),
    "fractional rows": ("rows = 2", "rows = 2.5", ["array.rows", "2.5"]),
    "unknown circuit": ("inverting-amplifier", "op-amp", ["readout.circuit", "op-amp"]),
    "no drive": ("-1.0", "0.0", ["drive", "voltage"]),
    "a number for a list": ("1000.0", "1000.0\nsupply = 3.3", ["readout.supply", "expected a list", "3.3"]),
    "integer of 5000 digits": ("70.0", "9" * 5000, ["design.toml", "TOML", "4300"]),
    "integer of 4000 digits": ("70.0", "9" * 4000, ["design.toml", "array.row_lead", "64 bits"]),
    "deep nesting": ("70.0", "[" * 3000 + "]" * 3000, ["design.toml", "TOML", "nested too deeply"]),
    "deep keys": ("70.0", "70.0\na" + ".a" * 3000 + " = 1", ["design.toml", "nested too deeply"]),
    "escape sequence": ("rows = 2", 'rows = 2\n"\\u001b[31mred" = 1', ["design.toml", r"\x1b[31mred"]),
    "not TOML": ("[array]", "[array", ["design.toml", "TOML"]),
    "wrong shape": ("columns = 3", "columns = 4", ["cells.csv", "2 lines of 3", "2 lines of 4"]),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_design_is_one_clear_line(fault: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after, named = BAD[fault]
    assert before in DESIGN
    (folder / "design.toml").write_text(DESIGN.replace(before, after, 1))
    _refused(["scan", "design.toml", "--cells", "cells.csv", "-o", "out.csv"], named, capsys)


@pytest.mark.parametrize(
    ("cells", "named"),
    [
        ("", ["cells.csv", "empty"]),
        ("\n\n", ["cells.csv", "empty"]),
        ("1,2,3\n4,-5,6\n", ["cells.csv", "line 2", "-5"]),
        ("1,2,3\n4,nan,6\n", ["cells.csv", "line 2", "nan"]),
        ("1,2,3\n4,five,6\n", ["cells.csv", "line 2", "'five'"]),
        ("1,2,3\n4,5\n", ["cells.csv", "line 2", "unequal"]),
        ("1 2 3\n4 5 6\n", ["cells.csv", "line 1", "separated by commas"]),
        ("1,2,3\n4,5,\n", ["cells.csv", "line 2"]),
        ("1,2\n3,4\n5,6\n", ["cells.csv", "3 lines of 2"]),
    ],
)
def test_bad_cells_are_one_clear_line(
    cells: str, named: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "cells.csv").write_text(cells)
    _refused(["scan", "design.toml", "--cells", "cells.csv", "-o", "out.csv"], named, capsys)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["scan", "nowhere.toml", "--cells", "cells.csv"], ["nowhere.toml"]),
        (["scan", "design.toml", "--cells", "nowhere.csv"], ["nowhere.csv"]),
        (["scan", "design.toml"], ["--cells"]),
        (["scan", "design.toml", "--cells", "cells.csv", "-o", "no/such/folder.csv"], ["folder.csv"]),
        (["scan", "design.toml", "--cells", "cells.csv", "--readout", "guess"], ["guess", "voltage-divider"]),
        (["scan", "design.toml", "--cells", "cells.csv", "--frobnicate"], ["--frobnicate"]),
        (["scna"], ["scna", "'scan'"]),
    ],
)
def test_bad_arguments_are_one_clear_line(
    arguments: list[str], named: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _refused(arguments, named, capsys)


def test_output_replaces_a_file_but_nothing_else(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scanning = ["scan", "design.toml", "--cells", "cells.csv", "-o"]
    for place in (".", "", "/dev/full"):
        _refused([*scanning, place], [place, "cannot be written"], capsys)
    assert Path("/dev/full").is_char_device()
    (folder / "real.csv").write_text("old")
    (folder / "link.csv").symlink_to("real.csv")
    assert run([*scanning, "link.csv"]) == 0
    assert (folder / "link.csv").is_symlink()
    assert (folder / "real.csv").read_text() != "old"
    assert run([*scanning, "/dev/stdout"]) == 0


def test_effects_are_listed_with_their_size(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["scan", "design.toml", "--cells", "cells.csv", "--effects"]) == 0
    lines = capsys.readouterr().out.splitlines()
    (lead,) = [line for line in lines if "modelled" in line]
    assert lead.startswith("row_lead")
    result = scan(Design.load("design.toml"), np.array([[1e4, 2e4, np.inf], [1e4, 1e4, 5e3]]))
    assert [effect.modelled for effect in effects(result.design, result.cells)].count(True) == 1
    assert len(lines) == len(effects(result.design, result.cells))


def test_a_log_shows_progress_where_there_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From what is told first, although nothing is told again for long; but nothing of a command that ends at once."""
    with progress_bar("verifying") as tell:
        tell(1, 4, "D1 crosstalk")
    assert not capsys.readouterr().err
    monkeypatch.setattr("ohmskin.cli._bar.FIRST_S", 0.01)
    shown = ""
    with progress_bar("verifying") as tell:
        tell(1, 4, "D1 crosstalk")
        while not shown:  # the test's own timeout is the judge
            shown = capsys.readouterr().err
    assert shown.splitlines()[0] == "verifying, 0 s: 25 %, D1 crosstalk"


def test_saturated_outputs_are_not_silent(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "design.toml").write_text(DESIGN + "supply = [0.0, 0.15]\n")
    assert run(["scan", "design.toml", "--cells", "cells.csv"]) == 0
    assert "1 outputs at a supply limit: (1, 2)" in capsys.readouterr().err
    assert run(["scan", "design.toml", "--cells", "cells.csv", "-o", "."]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_full_disk_behind_standard_output_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "ohmskin", "--help"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "No space left" in done.stderr


def test_a_reader_that_leaves_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-m", "ohmskin", "--help"], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert done.returncode == 141
    assert not done.stderr


def _broken(*args: object, **kwargs: object) -> None:
    raise OSError(5, "of a \x1b device")


def test_a_defect_is_one_line_with_an_exit_code_of_its_own(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ohmskin.common.tables.read_cells", _broken)
    scanning = ["scan", "design.toml", "--cells", "cells.csv"]
    assert run(scanning) == 70
    message = capsys.readouterr().err
    assert message == r"ohmskin: a defect of ohmskin, OSError: [Errno 5] of a \x1b device (--debug shows where)" + "\n"
    for arguments in (["--debug", *scanning], [*scanning, "--debug"]):
        assert run(arguments) == 70
        shown = capsys.readouterr().err
        assert "in _broken" in shown
        assert shown.endswith(message)


def test_an_interrupt_at_any_time_of_the_start_is_one_line() -> None:
    """The signal comes later and later, until the command is done before it comes."""
    outcomes = []
    for delay_ms in (0, 150, 400, 5000):
        with subprocess.Popen(
            [sys.executable, "-c", START], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(delay_ms / 1000)
            process.send_signal(signal.SIGINT)
            _, said = process.communicate()
        outcomes.append(process.returncode)
        if process.returncode == 0:
            break
        # At its very end Python gives signals back to the system, which ends the process without a word.
        assert (process.returncode, said) in ((130, b"ohmskin: interrupted\n"), (-signal.SIGINT, b""))
    assert 130 in outcomes


@pytest.mark.parametrize("closed", ["0<&-", "1>&-", "2>&-", "2>/dev/full", "0<&- 1>&- 2>&-"])
def test_streams_that_are_closed_or_broken_change_no_exit_code(closed: str, tmp_path: Path) -> None:
    """Nor does a file get the number of a closed stream, and with it what is said there."""
    for words, code in (("--version", 0), ("scan nowhere.toml --cells cells.csv", 2)):
        command = f"{shlex.quote(sys.executable)} -m ohmskin {words} {closed}"
        assert subprocess.run(["bash", "-c", command], cwd=tmp_path, check=False).returncode == code


def test_a_verdict_outlives_the_terminal(tmp_path: Path) -> None:
    wanted = '[[requirement]]\nid = "A"\nquantity = "cell_voltage"\nmax = {}\n'
    for limit, verdict in ((1e9, 0), (1e-9, 1)):
        (tmp_path / "wanted.toml").write_text(wanted.format(limit))
        for streams in (">/dev/full", "2>&- | true", ">&- 2>/dev/full"):
            words = f"-m ohmskin verify --requirements wanted.toml --only A -o {verdict} {streams}"
            command = f"set -o pipefail; {shlex.quote(sys.executable)} {words}"
            assert subprocess.run(["bash", "-c", command], cwd=tmp_path, check=False).returncode == verdict, streams
            report = json.loads((tmp_path / str(verdict) / "report.json").read_text())
            assert report["exit_code"] == verdict


def test_whatever_asks_to_exit_has_no_verdict(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def leave(*given: object, **options: object) -> None:
        raise SystemExit(0)

    monkeypatch.setattr("ohmskin.cli.verify.verify", leave)
    assert run(["verify"]) == 70
    assert "SystemExit" in capsys.readouterr().err


START = """
import sys
from ohmskin import __main__
__main__.signals.leave_at_once()
print("started", flush=True)
sys.argv = ["ohmskin", "verify", "--help"]
__main__.main()
"""


def test_a_shell_completes_commands_and_options(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("_OHMSKIN_COMPLETE", "bash_complete")
    for words, expected in (("ohmskin sc", "plain,scan"), ("ohmskin scan --js", "plain,--json")):
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
        assert run([]) == 0
        assert expected in capsys.readouterr().out.splitlines()


def _refused(arguments: list[str], named: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 2, one line on standard error that names what is wrong, and no new file."""
    before = set(Path().rglob("*"))
    assert run(arguments) == 2
    out, message = capsys.readouterr()
    assert not out
    assert message.count("\n") == 1
    assert message.startswith("ohmskin: ")
    for word in named:
        assert word in message
    assert set(Path().rglob("*")) == before
