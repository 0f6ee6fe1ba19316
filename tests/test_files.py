"""Output that replaces a file atomically, or is written through; input that is read up to a limit."""

from __future__ import annotations

import io
import os
import signal
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ohmskin.common.archives import Stored, read_array, read_arrays
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


# Arrays of files: sized before they are unpacked, and held against what their reader says of them


CELLS = ("rows", "columns")
MOST = 2**20


def npy(array: Any) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def header(descr: str, shape: str, data: bytes = b"") -> bytes:
    """An array that says anything of itself."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def archive(path: Path, *, packing: int = zipfile.ZIP_DEFLATED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", packing) as file:
        for name, content in members.items():
            file.writestr(name if "." in name else f"{name}.npy", content)
    return path


def read(path: Path, stored: Stored, most_bytes: int = MOST) -> Any:
    return read_arrays(path, {"x": stored}, what="thing", most_bytes=most_bytes)["x"]


@given(
    arrays(
        st.sampled_from([np.float64, np.float32, np.float16, ">f8", np.int32, np.uint8, np.bool_]),
        st.tuples(st.integers(0, 3), st.integers(0, 3)),
    ),
    st.booleans(),
    st.booleans(),
)
def test_what_numpy_writes_is_read(
    tmp_path_factory: pytest.TempPathFactory, x: Any, fortran: bool, packed: bool
) -> None:
    path = tmp_path_factory.mktemp("a") / "x.npz"
    (np.savez_compressed if packed else np.savez)(path, x=np.asfortranarray(x) if fortran else x)
    found = read(path, Stored("numbers", CELLS, nan=True))
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, x)


def test_text_flags_records_and_single_values_are_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", x=np.array(["a", "bé\n"]), empty=np.array([], dtype=str), one=np.array(7), y=[True])
    schema = {
        "x": Stored("text", ("n",)),
        "empty": Stored("text", ("none",)),
        "one": Stored("whole numbers", least=0),
        "y": Stored("flags", ("m",)),
        "nowhere": Stored("numbers", optional=True),
    }
    found = read_arrays(tmp_path / "x.npz", schema, what="thing", most_bytes=MOST)
    assert found.keys() == schema.keys() - {"nowhere"}
    assert (found["x"].tolist(), found["empty"].tolist(), int(found["one"])) == (["a", "bé\n"], [], 7)
    records = np.zeros(3, [("x", "<f8", (2, 2)), ("n", "<i8")])
    records["x"] = np.arange(12).reshape(3, 2, 2)
    np.save(tmp_path / "r.npy", records)
    np.testing.assert_array_equal(read(tmp_path / "r.npy", Stored("numbers", ("f", *CELLS))), records["x"])
    np.save(tmp_path / "p.npy", records["n"])
    assert read_array(tmp_path / "p.npy", Stored("numbers", ("n",)), what="thing", most_bytes=MOST).shape == (3,)


HUGE = "(1000000000, 10000)"
REFUSED = [
    ("declared", header("'<f8'", HUGE), "larger than"),
    ("beyond all", header("'<f8'", f"({2**70}, 4)"), "larger than"),
    ("nothing of much", header("'<f8'", f"({2**70}, 0)"), "larger than"),
    ("nothing each", header("'<U0'", HUGE), "larger than"),
    ("a bomb", header("'<f8'", "(1000, 1000)", bytes(8_000_000)), "larger than"),
    ("cut off", header("'<f8'", "(4, 4)", bytes(100)), "other bytes than its header says"),
    ("too long", header("'<f8'", "(4, 4)", bytes(200)), "other bytes than its header says"),
    ("objects", header("'|O'", "(4, 4)", bytes(128)), "of type |O"),
    ("records", header("[('a', '<f8')]", "(4, 4)", bytes(128)), "expected numbers (rows, columns)"),
    ("times", header("'<M8[s]'", "(4, 4)", bytes(128)), "of type"),
    ("complex", npy(np.ones((4, 4), complex)), "of type"),
    ("text", npy(np.full((4, 4), "1")), "expected numbers (rows, columns)"),
    ("a call", header("__import__('os').getcwd()", "(4, 4)", bytes(128)), "no array that can be read"),
    ("brackets", header("'<f8'", "(" * 4000), "no array that can be read"),
    ("minus", header("'<f8'", "-" * 9000 + "1"), "no array that can be read"),
    ("negative", header("'<f8'", "(-4, -4)", bytes(128)), "of shape (-4, -4)"),
    ("no number", header("'<f8'", "(True, 4)", bytes(32)), "of shape (True, 4)"),
    ("another header", b"\x93NUMPY\x01\x00\x02\x00{}", "no array that can be read"),
    ("a later version", b"\x93NUMPY\x09\x00", "no array that can be read"),
    (
        "a version that NumPy refuses",
        npy(np.ones((4, 4))).replace(b"NUMPY\x01\x00", b"NUMPY\x01\x01"),
        "no array that can be read",
    ),
    ("no header", b"hello", "no array of NumPy"),
    ("nothing", b"", "no array of NumPy"),
    ("one axis", npy(np.ones(4)), "expected numbers (rows, columns)"),
    ("too much", npy(np.full((2, 2), 1e308)), "'x' is 1e+308 at [0, 0]; expected numbers from 0 to 1e+30"),
    ("no value", npy(np.full((2, 2), np.nan)), "'x' is nan at [0, 0]"),
    ("below", npy(np.array([[0.0, 1.0], [-1.0, 0.0]])), "'x' is -1.0 at [1, 0]"),
]


@pytest.mark.parametrize(("content", "message"), [case[1:] for case in REFUSED], ids=[case[0] for case in REFUSED])
def test_what_is_not_as_the_reader_says_is_refused_in_one_line(content: bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read(archive(tmp_path / "x.npz", x=content), Stored("numbers", CELLS, 0.0, 1e30))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_member_of_another_name_is_not_read_in_place_of_an_array(tmp_path: Path) -> None:
    """NumPy takes a member without .npy as well, which counts of sizes by name would miss."""
    with zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("x", npy(np.zeros(2_000_000)))
    with pytest.raises(InputError, match="has no array 'x'; expected a thing"):
        read(tmp_path / "x.npz", Stored("numbers", ("n",)))


def test_what_numpy_takes_for_no_archive_is_none(tmp_path: Path) -> None:
    sound = archive(tmp_path / "x.npz", x=npy(np.ones((2, 2)))).read_bytes()
    (tmp_path / "x.npz").write_bytes(b"," + sound)
    with pytest.raises(InputError, match="does not begin as an archive"):
        read(tmp_path / "x.npz", Stored("numbers", CELLS))


@given(st.lists(st.integers(0, 255), min_size=1), st.sampled_from(["?", "u1", "i2", "u8"]))
def test_flags_are_zeros_and_ones(tmp_path_factory: pytest.TempPathFactory, values: list[int], dtype: str) -> None:
    """Of a boolean array, too, whose bytes in a file may be any."""
    numbers = np.array(values, np.uint8)
    content = header("'|b1'", f"({len(values)},)", numbers.tobytes()) if dtype == "?" else npy(numbers.astype(dtype))
    path = archive(tmp_path_factory.mktemp("a") / "x.npz", x=content)
    if set(values) <= {0, 1}:
        assert read(path, Stored("flags", ("n",))).tolist() == [bool(value) for value in values]
    else:
        with pytest.raises(InputError, match="'x' has values other than 0 and 1; expected flags"):
            read(path, Stored("flags", ("n",)))


def test_axes_of_one_name_have_one_length(tmp_path: Path) -> None:
    path = archive(tmp_path / "x.npz", x=npy(np.ones((2, 3))), y=npy(np.ones(4)))
    with pytest.raises(InputError, match="'y' has 4 columns, and 'x' 3"):
        read_arrays(
            path, {"x": Stored("numbers", CELLS), "y": Stored("numbers", ("columns",))}, what="", most_bytes=MOST
        )


def test_archives_are_limited_and_packed_as_numpy_packs_them(tmp_path: Path) -> None:
    stored = Stored("numbers", CELLS)
    with pytest.raises(InputError, match="packed as NumPy packs no array"):
        read(archive(tmp_path / "x.npz", packing=zipfile.ZIP_LZMA, x=npy(np.ones((2, 2)))), stored)
    many = {f"m{number}.txt": b"" for number in range(20_000)}
    with pytest.raises(InputError, match="a directory of"):
        read(archive(tmp_path / "x.npz", x=npy(np.ones((2, 2))), **many), stored, most_bytes=2**30)
    with pytest.raises(InputError, match="larger than 100 bytes"):
        read(archive(tmp_path / "x.npz", x=npy(np.ones((2, 2)))), stored, most_bytes=100)
    damaged = bytearray(archive(tmp_path / "x.npz", packing=zipfile.ZIP_STORED, x=npy(np.ones((2, 2)))).read_bytes())
    damaged[damaged.index(struct.pack("<d", 1.0))] ^= 1
    (tmp_path / "x.npz").write_bytes(damaged)
    with pytest.raises(InputError, match="CRC"):
        read(tmp_path / "x.npz", stored)


def test_a_declared_size_takes_no_memory(tmp_path: Path) -> None:
    """Even below the limit of the file: what is packed in so few bytes cannot be so large."""
    path = archive(tmp_path / "x.npz", x=header("'<f8'", "(100000, 1000)"))
    data = bytearray(path.read_bytes())
    claimed = len(header("'<f8'", "(100000, 1000)")) + 800_000_000
    start = data.index(b"PK\x01\x02") + 24
    data[start : start + 4] = struct.pack("<I", claimed)
    path.write_bytes(data)
    with pytest.raises(InputError, match="other bytes than its header says"):
        read(path, Stored("numbers", CELLS), most_bytes=2**31)
