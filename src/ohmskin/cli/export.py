"""``ohmskin export``: a recording to arrays or tables."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from ..arrays import AnyArray
from ..driver import Frame, Skin
from ..errors import InputError, MissingExtra
from ..files import whole_file
from . import arguments
from ._bar import progress_bar

SCALARS = ("sequence", "device_time", "host_time", "lost_before", "overrun", "reconnected", "rebooted")
GRIDS = ("counts", "valid", "resistance", "pressure", "pressure_std")
KINDS = (".npz", ".csv", ".parquet")


@click.command(epilog=arguments.example("ohmskin export press.mcap -o press.npz"))
@click.argument("recording", metavar="FILE.mcap", type=click.Path(path_type=Path))
@click.option("-o", "output", required=True, type=click.Path(path_type=Path), metavar="FILE.npz|.csv|.parquet")
def command(recording: Path, output: Path) -> None:
    """Convert FILE.mcap as the driver does, and write every frame.

    .npz has an array for each field of a frame, with the frames along its first axis, and `time`, the host's. .csv and
    .parquet have a row for each frame: its numbers, then pressure_kpa_R_C and resistance_ohm_R_C for each cell.
    """
    kind = output.suffix.lower()
    if kind not in KINDS:
        raise InputError(f"{output}: expected a name that ends in {', '.join(KINDS)}")
    if recording.suffix.lower() != ".mcap":
        raise InputError(f"{recording}: is no name of a recording; expected FILE.mcap")
    arrays = _read(recording)
    with whole_file(output) as file:
        if kind == ".npz":
            np.savez_compressed(file, allow_pickle=False, **arrays)
        elif kind == ".csv":
            columns = _columns(arrays)
            file.write((",".join(columns) + "\n").encode())
            for row in zip(*columns.values(), strict=True):
                file.write((",".join(map(_text, row)) + "\n").encode())
        else:
            _write_parquet(_columns(arrays), file)


def _read(recording: Path) -> dict[str, AnyArray]:
    """The frames of a recording: name -> array with the frames along its first axis."""
    with Skin.open(str(recording)) as skin, progress_bar("exporting") as tell:
        frames: list[dict[str, AnyArray]] = []
        for frame in skin:
            frames.append(_kept(frame))
            tell(len(frames), len(frames) + 1, "frames")
        shape = skin.design.array.shape
    if not frames:
        empty = {name: np.empty((0, *shape)) for name in GRIDS} | {name: np.empty(0) for name in SCALARS}
        return empty | {"time": np.empty(0), "sequence": np.empty(0, dtype=np.int64)}
    arrays = {name: np.array([frame[name] for frame in frames]) for name in (*SCALARS, *GRIDS)}
    return arrays | {"time": arrays["host_time"]}


def _kept(frame: Frame) -> dict[str, AnyArray]:
    values = frame.as_dict()
    return {name: values[name] for name in (*SCALARS, *GRIDS)}


def _columns(arrays: dict[str, AnyArray]) -> dict[str, AnyArray]:
    columns = {name: arrays[name] for name in SCALARS}
    for name, title in (("pressure", "pressure_kpa"), ("resistance", "resistance_ohm")):
        rows, count = arrays[name].shape[1:]
        columns |= {f"{title}_{r}_{c}": arrays[name][:, r, c] for r in range(rows) for c in range(count)}
    return columns


def _text(value: object) -> str:
    if isinstance(value, np.bool_):
        return str(int(value))
    if isinstance(value, np.floating):
        return "" if np.isnan(value) else repr(float(value))
    return str(value)


def _write_parquet(columns: dict[str, AnyArray], file: object) -> None:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingExtra(".parquet needs pyarrow: pip install 'ohmskin[parquet]'") from error
    parquet.write_table(pyarrow.table(columns), file)
