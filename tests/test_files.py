"""Output that replaces a file atomically, or is written through; input that is read up to a limit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ohmskin.common.config import read_toml
from ohmskin.common.files import check_writable, read_bytes, whole_file, write_together
from ohmskin.common.tables import read_cells, read_columns, write_text
from ohmskin.errors import InputError, LinkError

SCANNING = [sys.executable, "-m", "ohmskin", "scan", "design.toml", "--cells", "cells.csv", "-o"]


@pytest.fixture
def design(tmp_path: Path) -> Path:
    (tmp_path / "design.toml").write_text(
        "array = {rows = 1, columns = 2}\ndrive.voltage = -1.0\n"
        "readout = {circuit = 'inverting-amplifier', reference_resistance = 1e3}\n"
    )
    (tmp_path / "cells.csv").write_text("1e4,2e4\n")
    return tmp_path


def test_output_to_a_descriptor_appends_where_the_shell_appends(design: Path) -> None:
    record = design / "all.csv"
    record.write_text("earlier\n")
    for place in ("/dev/stdout", "/proc/self/fd/1"):
        with record.open("a") as stdout:
            subprocess.run([*SCANNING, place], cwd=design, stdout=stdout, check=True)
    lines = record.read_text().splitlines()
    assert lines[0] == "earlier"
    assert len(lines) == 3
    assert len(set(lines[1:])) == 1
    assert sorted(path.name for path in design.iterdir()) == ["all.csv", "cells.csv", "design.toml"]


@pytest.mark.parametrize("error", [InputError("of the content"), LinkError("of a port"), KeyboardInterrupt()])
def test_an_error_within_the_block_leaves_the_old_file(error: BaseException, tmp_path: Path) -> None:
    file = tmp_path / "kept.csv"
    file.write_text("old")

    def write() -> None:
        with whole_file(file) as output:
            output.write(b"half")
            raise error

    with pytest.raises(type(error)) as caught:
        write()
    assert caught.value is error
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_files_are_replaced_together_or_not_at_all(tmp_path: Path) -> None:
    first, second, third = (tmp_path / name for name in ("report.json", "report.html", "junit.xml"))
    for file in (first, second, third):
        file.write_text("old")
    (tmp_path / "taken").mkdir()
    with pytest.raises(InputError, match="taken: cannot be written: is a directory"):
        write_together({first: b"new", tmp_path / "taken": b"new"})
    assert first.read_text() == "old"
    write_together({first: b"new", second: b"new", third: None})
    assert [first.read_text(), second.read_text(), third.exists()] == ["new", "new", False]
    assert len(list(tmp_path.iterdir())) == 3


def test_a_place_is_checked_without_touching_it(tmp_path: Path) -> None:
    file = tmp_path / "old.csv"
    file.write_text("old")
    check_writable(file, tmp_path / "new.csv", "/dev/full", "/dev/stdout")
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]
    for place, reason in ((tmp_path, "is a directory"), (tmp_path / "no" / "new.csv", "No such file"), ("a\0b", "NUL")):
        with pytest.raises(InputError, match=reason):
            check_writable(place)


@pytest.mark.parametrize("device", ["/dev/full", "/dev/zero", "/dev/urandom"])
def test_endless_input_is_refused(device: str) -> None:
    with pytest.raises(InputError, match="larger than 16 MiB"):
        read_toml(device)
    with pytest.raises(InputError, match=r"longer than 1 MiB|can't decode"):
        read_cells(device, (2, 2))


def test_endless_lines_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ohmskin.common.tables.MOST_RECORDING_BYTES", 10_000)
    file = tmp_path / "long.csv"
    file.write_text("time_s\n" + "1\n" * 4_990)
    assert read_columns(file, ("time_s",))["time_s"].sum() == 4_990
    file.write_text("time_s\n" + "1\n" * 5_000)
    with pytest.raises(InputError, match="larger than 9 KiB"):
        read_columns(file, ("time_s",))
    with pytest.raises(InputError, match="larger than 5 bytes"):
        read_bytes(file, most_bytes=5)


@pytest.mark.parametrize("head", [b"", b"\xef\xbb\xbf"])
def test_a_byte_order_mark_is_no_part_of_the_text(head: bytes, tmp_path: Path) -> None:
    file = tmp_path / "marked"
    file.write_bytes(head + b"key = 1\n")
    assert read_toml(file) == {"key": 1}
    file.write_bytes(head + b"1,2\n")
    assert read_cells(file, (1, 2)).tolist() == [[1.0, 2.0]]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_partial_file(number: int, tmp_path: Path) -> None:
    code = (
        "import signal, time; from ohmskin.common import signals; from ohmskin.common.files import whole_file\n"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup, under which tests may run, has it ignored\n"
        "signals.leave_at_once(); signals.raise_from_now_on()\n"
        "with whole_file('out') as file:\n"
        "    print('open', flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, stderr=-3) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(number)
        assert process.wait() != 0
    assert not list(tmp_path.iterdir())


def test_a_pipe_is_written_through_and_a_replaced_file_keeps_its_mode(tmp_path: Path) -> None:
    pipe, private = tmp_path / "pipe", tmp_path / "private.csv"
    os.mkfifo(pipe)
    with subprocess.Popen(["cat", pipe], stdout=subprocess.PIPE) as reader:
        write_text(pipe, "through\n")
        assert reader.stdout is not None
        assert reader.stdout.read() == b"through\n"
    assert pipe.is_fifo()
    private.write_text("old")
    private.chmod(0o640)
    write_text(private, "new")
    assert private.stat().st_mode & 0o777 == 0o640


SPREADSHEETS = {
    "semicolons, decimal commas": "1000,5;OL\n0;4,7k\n",
    "tabs": "1000.5\tinf\n0\t4700\n",
    "tabs, decimal commas": "1000,5\tinf\n0\t4700,0\n",
    "declared, a header, comments": "sep=;\n# by hand\ncolumn 1;column 2\n1000,5;ol\n\n0;4.7 kohm\n",
    "a header between commas": "c0,c1\n1000.5,inf\n0,4.7k\n",
}


@pytest.mark.parametrize("name", SPREADSHEETS)
def test_cells_as_spreadsheets_write_them(name: str, tmp_path: Path) -> None:
    file = tmp_path / "cells.csv"
    file.write_text(SPREADSHEETS[name])
    assert read_cells(file, (2, 2)).tolist() == [[1000.5, np.inf], [0.0, 4700.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1;2\n3;x\n", "line 2: 'x' is not a number"),
        ("1\t2\n4,700\t3\n", "line 2: '4,700' may be a decimal comma or a thousands separator"),
        ("1.000,5;2\n3;4\n", "line 1: '1.000,5' is not a number"),
        ("4k7,1\n1,1\n", "line 1: '4k7' is not a number"),
        ("# only\n", "is empty"),
        ("a,b\n1,2\n", "has 1 lines of 2"),
    ],
)
def test_cells_that_could_mean_two_things_are_refused(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "cells.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_cells(file, (2, 2))


def test_recordings_as_spreadsheets_write_them(tmp_path: Path) -> None:
    """Dates become seconds, and a last line that was cut off is left out with a note."""
    file = tmp_path / "run.csv"
    rows = [f"2026-03-01T12:00:{second:02d}.5;{1000 + second},5" for second in range(20)]
    file.write_text("sep=;\ntime_s;resistance_ohm\n" + "\n".join([*rows, "2026-03-01T12:0"]))
    notes: list[str] = []
    found = read_columns(file, ("time_s", "resistance_ohm"), note=notes.append)
    assert found["time_s"].tolist() == list(range(20))
    assert found["resistance_ohm"][1] == 1001.5
    assert found["line"].tolist() == list(range(3, 23))
    assert notes == [f"{file}: line 23 is cut off, and left out"]
    for more in ("5;1\n", "2026-03-01T12:00:59+00:00;1\n"):
        file.write_text("time_s;resistance_ohm\n" + "\n".join([*rows, more]))
        with pytest.raises(InputError, match="line 22: "):
            read_columns(file, ("time_s", "resistance_ohm"))
