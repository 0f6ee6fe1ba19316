"""NumPy archives (.npz) and arrays (.npy) from users: size limits, and one-line errors that name the file."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from ..common.arrays import AnyArray, FloatArray
from ..common.files import size
from ..errors import InputError

MOST_BYTES = 4 << 30
"""size limit of an archive in memory: 1 h of 16 x 16 cells at 100 Hz takes 2.2 GB per quantity in a truth file"""


def read_arrays(path: str | Path, names: Iterable[str], *, most_bytes: int = MOST_BYTES) -> Mapping[str, AnyArray]:
    """Those of the named arrays that a .npz file has, or the fields of a .npy file with a structured array.

    Raises:
        InputError: the file cannot be read, is of another kind, or is larger than ``most_bytes`` when unpacked.

    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".npy":
            if path.stat().st_size > most_bytes:
                raise InputError(f"{path}: larger than {size(most_bytes)}, the limit for this kind of file")
            record = np.load(path, allow_pickle=False)
            return {name: record[name] for name in names if name in (record.dtype.names or ())}
        with zipfile.ZipFile(path) as archive:
            wanted = {f"{name}.npy" for name in names}
            unpacked = sum(member.file_size for member in archive.infolist() if member.filename in wanted)
        if unpacked > most_bytes:
            raise InputError(f"{path}: unpacks to more than {size(most_bytes)}, the limit for this kind of file")
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names if name in arrays}
    except InputError:
        raise
    except zipfile.BadZipFile as error:
        raise InputError(f"{path}: is no .npz file: {error}") from error
    except (OSError, ValueError, EOFError, KeyError, NotImplementedError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"{path}: cannot be read: {reason}") from error


def numbers(path: str | Path, name: str, array: AnyArray, dimensions: int) -> FloatArray:
    """``array`` as float64 with so many dimensions. Raises InputError."""
    if array.ndim != dimensions or array.dtype.kind not in "biuf":
        raise InputError(
            f"{path}: '{name}' is {array.dtype} of shape {array.shape}; expected numbers in {dimensions} dimensions"
        )
    return np.asarray(array, dtype=np.float64)
