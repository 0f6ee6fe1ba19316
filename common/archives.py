"""Arrays from files: NumPy archives (.npz) and arrays (.npy), held against a schema before anything is unpacked.

A file may come from an untrusted source. Its reader states what each array may be (kind, axes, range) as a
:class:`Stored`. How large it would be follows from the headers of zip and npy, which are read first. No other module
opens such files: ``tests/test_architecture.py``. The format of .npy is in NumPy's documentation, ``numpy.lib.format``.
"""

from __future__ import annotations

import ast
import io
import math
import re
import struct
import sys
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, cast

import numpy as np

from ..errors import InputError
from .arrays import AnyArray
from .files import reading, size
from .text import one_line, shortened

MOST_DIRECTORY_BYTES = 2**20
"""of the directory of an archive: thousands of arrays; Python makes objects of ten times that size"""
MOST_HEADER_BYTES = 10_000
"""of an array's header"""
_MOST_WHOLE = 2.0**53
"""up to which floating-point numbers are exact"""
_MOST_EXPANSION = 1100
"""bytes that Deflate makes of one, at most: 1032 (RFC 1951)"""
_PIECE = 2**20
"""bytes that are unpacked at a time"""
_MAGIC, _ARCHIVES = b"\x93NUMPY", (b"PK\x03\x04", b"PK\x05\x06")
_LENGTHS = {b"\x01\x00": "<H", b"\x02\x00": "<I"}
"""of the header, by version of the format, as NumPy reads it; version 3 is for names of fields beyond ASCII"""
_TYPE = re.compile(r"[<>|=]?(\?|b1|[iu][1248]|f[248]|U\d{1,6})")
_KINDS = {"numbers": "biuf", "whole numbers": "iuf", "flags": "biu", "text": "U"}
"""NumPy's letters of the types that are taken for a kind"""
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError),
    *(NotImplementedError, RuntimeError, ValueError, OverflowError),
)
"""what :mod:`zipfile` raises for archives that are cut off, damaged, encrypted, or packed in another way"""


@dataclass(frozen=True)
class Stored:
    """What an array of a file must be."""

    kind: Literal["numbers", "whole numbers", "flags", "text"]
    """numbers become float64, whole numbers int64, flags bool"""
    axes: tuple[str, ...] = ()
    """axes of the same name have the same length in all arrays; none: one value"""
    least: float = -math.inf
    most: float = math.inf
    """of the values"""
    nan: bool = False
    """whether values may be NaN"""
    optional: bool = False

    def __str__(self) -> str:
        return f"{self.kind} ({', '.join(self.axes)})"

    @property
    def values(self) -> str:
        """What each value must be, in words."""
        if self.least == -math.inf and self.most == math.inf:
            return self.kind
        return f"{self.kind} from {self.least:g} to {self.most:g}"


def read_arrays(path: str | Path, schema: Mapping[str, Stored], *, what: str, most_bytes: int) -> dict[str, AnyArray]:
    """The named arrays of a .npz file, or the fields of a .npy file with an array of records.

    Args:
        path: of the file.
        schema: what is read, by name; everything else in the file is left alone.
        what: kind of file, for messages: "saved tare".
        most_bytes: limit of the file, and of all these arrays in memory.

    Raises:
        InputError: the file cannot be read or is of another kind, an array is missing or is not what the schema says,
            or they are larger than ``most_bytes`` together. The message is one line.

    """
    with reading(path) as file:
        source = _Source(file, path, what, most_bytes)
        found = source.records(schema) if Path(path).suffix.lower() == ".npy" else source.members(schema)
    return check_arrays(found, schema, path=path, what=what)


def read_array(path: str | Path, stored: Stored, *, what: str, most_bytes: int) -> AnyArray:
    """The one array of a .npy file; arguments and errors as of :func:`read_arrays`."""
    with reading(path) as file:
        values = _Source(file, path, what, most_bytes).only(stored)
    return _checked(values, "the array", stored, path)


def check_arrays(
    arrays: Mapping[str, AnyArray], schema: Mapping[str, Stored], *, path: str | Path, what: str
) -> dict[str, AnyArray]:
    """Those of the arrays that the schema names, in the types of their kinds; arguments and errors of `read_arrays`."""
    found: dict[str, AnyArray] = {}
    lengths: dict[str, tuple[int, str]] = {}
    for name, stored in schema.items():
        if name not in arrays:
            if not stored.optional:
                raise InputError(f"{path}: has no array '{name}'; expected a {what}")
            continue
        found[name] = _checked(arrays[name], name, stored, path)
        for axis, length in zip(stored.axes, found[name].shape, strict=True):
            before, other = lengths.setdefault(axis, (length, name))
            if length != before:
                raise InputError(f"{path}: '{name}' has {length} {axis}, and '{other}' {before}; expected as many")
    return found


def _checked(values: AnyArray, name: str, stored: Stored, path: str | Path) -> AnyArray:
    """The values in the type of their kind, within their limits. Raises InputError."""
    _check_kind(name, stored, values.dtype, values.shape, path)
    if stored.kind == "flags":
        written = values.view(np.uint8) if values.dtype.kind == "b" else values  # a file may have any byte for a flag
        if not ((written == 0) | (written == 1)).all():
            raise InputError(f"{path}: '{name}' has values other than 0 and 1; expected {stored.values}")
        return values.astype(np.bool_, copy=False)
    if stored.kind == "text":
        text = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("=")))
        if text.nbytes and (text.view(np.uint32) > sys.maxunicode).any():
            raise InputError(f"{path}: '{name}' has letters that are none")
        return values
    if values.dtype.kind == "f":  # a half holds no limit
        values = values.astype(np.float64, copy=False)
    kept = (values >= stored.least) & (values <= stored.most)
    if stored.kind == "whole numbers":
        kept &= (values >= -_MOST_WHOLE) & (values <= _MOST_WHOLE) & (values == np.floor(values))
    if stored.nan:
        kept |= np.isnan(values)
    if not kept.all():
        place = tuple(int(index) for index in np.argwhere(~kept)[0])
        where = f" at {list(place)}" if place else ""
        raise InputError(f"{path}: '{name}' is {values[place]}{where}; expected {stored.values}")
    return values.astype(np.int64 if stored.kind == "whole numbers" else np.float64, copy=False)


def _check_kind(name: str, stored: Stored, dtype: np.dtype[Any], shape: tuple[int, ...], path: str | Path) -> None:
    if dtype.kind not in _KINDS[stored.kind] or len(shape) != len(stored.axes):
        raise InputError(f"{path}: '{name}' is {dtype} of shape {shape}; expected {stored}")


class _Header(NamedTuple):
    """What stands before the values of an array."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    by_columns: bool
    """whether the first axis is the fastest, as in Fortran"""
    bytes_read: int


class _Source:
    """An open file, and how many bytes of it may still be unpacked."""

    def __init__(self, file: IO[bytes], path: str | Path, what: str, most_bytes: int) -> None:
        self._file, self._path, self._what, self._most_bytes = file, path, what, most_bytes
        self._left = most_bytes
        self._length = file.seek(0, io.SEEK_END)
        file.seek(0)
        if self._length > most_bytes:
            raise self._too_large()

    def members(self, schema: Mapping[str, Stored]) -> dict[str, AnyArray]:
        """The arrays of an archive, where they are there."""
        found = {}
        try:
            if self._file.read(4) not in _ARCHIVES:  # zipfile takes archives behind anything else
                raise zipfile.BadZipFile("it does not begin as an archive")
            directory = _Directory(self._file)
            with zipfile.ZipFile(cast(IO[bytes], directory)) as archive:
                directory.most_bytes = None
                there = {member.filename: member for member in archive.infolist()}
                for name, stored in schema.items():
                    if (member := there.get(f"{name}.npy")) is None:
                        continue
                    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                        raise InputError(f"{self._path}: '{name}' is packed as NumPy packs no array")
                    with archive.open(member) as stream:
                        header = self._header(stream, f"'{name}'")
                        unpacked = header.bytes_read + self._claim(header)
                        packed = min(member.compress_size, self._length)
                        if unpacked != member.file_size or unpacked > _MOST_EXPANSION * packed:
                            raise self._no_array(f"'{name}'", "it has other bytes than its header says")
                        found[name] = self._array(stream, name, stored, header)
                        stream.read(1)  # the end, where zipfile compares the checksum
        except InputError:
            raise
        except _DAMAGE as error:
            raise InputError(
                f"{self._path}: is no {self._what}: {shortened(one_line(str(error)), 100)}; expected an archive (.npz)"
            ) from error
        return found

    def records(self, schema: Mapping[str, Stored]) -> dict[str, AnyArray]:
        """The fields of an array of records, where they are there."""
        header = self._header(self._file, "the file")
        fields = header.dtype.names or ()
        if not fields or len(header.shape) != 1:
            raise self._no_array("the file", "it has no records")
        self._claim(header, most=self._length)
        table = self._values(self._file, "the file", header)
        return {name: table[name] for name in schema if name in fields}

    def only(self, stored: Stored) -> AnyArray:
        header = self._header(self._file, "the file")
        self._claim(header, most=self._length)
        return self._array(self._file, "the array", stored, header)

    def _array(self, stream: IO[bytes], name: str, stored: Stored, header: _Header) -> AnyArray:
        _check_kind(name, stored, header.dtype, header.shape, self._path)
        return self._values(stream, f"'{name}'", header)

    def _header(self, stream: IO[bytes], name: str) -> _Header:
        try:
            head = stream.read(len(_MAGIC) + 2)
            if head[:-2] != _MAGIC:
                raise ValueError("no array of NumPy")
            field = struct.Struct(_LENGTHS[head[-2:]])
            (length,) = field.unpack(stream.read(field.size))
            if length > MOST_HEADER_BYTES:
                raise ValueError(f"a header of {length} bytes")
            says = ast.literal_eval(stream.read(length).decode("ascii"))
            descr, by_columns, shape = (says[key] for key in ("descr", "fortran_order", "shape"))
            return _Header(_dtype(descr), _shape(shape), by_columns is True, len(head) + field.size + length)
        except (*_DAMAGE, KeyError, IndexError, TypeError, SyntaxError, MemoryError) as error:
            raise self._no_array(name, str(error)) from error

    def _claim(self, header: _Header, most: float = math.inf) -> int:
        """Bytes of the values. Raises InputError for more than ``most``, or than there may be in memory."""
        count, each = math.prod(header.shape), header.dtype.itemsize
        needed = count * (each if header.dtype.kind in "UV" else max(each, 8))  # numbers become 8 bytes each
        if max(count, needed, *header.shape, 0) > self._left:
            raise self._too_large()
        if count * each > most:
            raise self._no_array("the file", "it is cut off")
        self._left -= needed
        return count * each

    def _values(self, stream: IO[bytes], name: str, header: _Header) -> AnyArray:
        """The values behind a header."""
        values = np.empty(header.shape, header.dtype, order="F" if header.by_columns else "C")
        if not values.nbytes:
            return values
        view = values.reshape(-1, order="A").view(np.uint8).data
        filled = 0
        while filled < values.nbytes:
            piece = stream.read(min(_PIECE, values.nbytes - filled))
            if not piece:
                raise self._no_array(name, "it is cut off")
            view[filled : filled + len(piece)] = piece
            filled += len(piece)
        return values

    def _no_array(self, name: str, reason: str) -> InputError:
        said = shortened(one_line(reason), 100)
        return InputError(f"{self._path}: is no {self._what}: {name} is no array that can be read: {said}")

    def _too_large(self) -> InputError:
        return InputError(f"{self._path}: larger than {size(self._most_bytes)}, the limit of a {self._what}")


class _Directory:
    """The file as :class:`zipfile.ZipFile` reads it: a limited number of bytes at a time while it reads the directory,
    of whose every 46 bytes it makes an object.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self.most_bytes: int | None = MOST_DIRECTORY_BYTES
        self.seek, self.tell, self.seekable, self._read = file.seek, file.tell, file.seekable, file.read

    def read(self, count: int = -1) -> bytes:
        if self.most_bytes is not None and count > self.most_bytes:
            raise zipfile.BadZipFile(f"a directory of {size(count)}")
        return self._read(count)


def _shape(says: object) -> tuple[int, ...]:
    if not isinstance(says, tuple) or not all(type(length) is int and length >= 0 for length in says):
        raise ValueError(f"of shape {says}")
    return says


def _dtype(says: object) -> np.dtype[Any]:
    """A simple type, or records of such and of arrays of them. Raises ValueError."""
    if isinstance(says, str) and _TYPE.fullmatch(says):
        return np.dtype(says)
    if isinstance(says, list) and says:
        return np.dtype([(str(name), _dtype(kind), _shape(*shape or ((),))) for name, kind, *shape in says])
    raise ValueError(f"of type {says}")
