"""``ohmskin export``: a recording to arrays or tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path

import click
import numpy as np

from ..circuits import Shape
from ..common.arrays import AnyArray
from ..common.extras import install_command
from ..common.files import check_writable, whole_file
from ..common.geometry import Geometry
from ..driver import FRAME_NUMBERS, Contact, Frame, Skin, stack, to_xarray
from ..errors import InputError, MissingExtra
from . import arguments
from ._recording import played_frames

OF_CIRCUIT = {
    "pressure": "pressure_kpa",
    "pressure_std": "pressure_std_kpa",
    "resistance": "resistance_ohm",
    "counts": "counts",
    "valid": "valid",
}
OF_COUNTS = {name: name for name in ("counts", "rest_counts", "valid")}
"""grids of a table, and the heads of their columns: with a known circuit, and without"""
TABLES = (".csv", ".parquet")
KINDS = (".npz", *TABLES, ".nc")


@click.command(
    epilog=arguments.example("ohmskin export press.mcap -o press.npz", "ohmskin export press.mcap -o press.nc")
)
@click.argument("recordings", metavar="FILE.mcap...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "output", required=True, type=click.Path(path_type=Path), metavar="FILE.npz|.csv|.parquet|.nc")
def command(recordings: tuple[Path, ...], output: Path) -> None:
    """Convert FILE.mcap as the driver does, and write every frame.

    .npz has an array for each field of a frame, with the frames along its first axis, `time`, the host's, and the
    contacts of all frames in a row: contact_frame is the frame of each; place_mm and area_mm2 are those of the cells.
    .csv and .parquet have a row per frame: its numbers, the number of contacts and their force_n, then
    pressure_kpa_R_C, pressure_std_kpa_R_C, resistance_ohm_R_C, counts_R_C and valid_R_C for each cell; counts_R_C,
    rest_counts_R_C and valid_R_C where the board's circuit is not known. Places of a skin with a [shape] go into a
    second file beside it, .shape.csv. .nc is netCDF for xarray, with the dimensions time, row, column, units, and
    places of the cells in mm. Several recordings are those of the boards of one skin. What is not known is empty in
    tables, and NaN elsewhere.
    """
    kind = output.suffix.lower()
    if kind not in KINDS:
        raise InputError(f"{output}: expected a name that ends in {', '.join(KINDS)}")
    check_writable(output)
    with played_frames(recordings, "exporting") as (skin, frames):
        if kind == ".nc":
            content = _as_netcdf(frames, skin)
        else:
            touched: list[tuple[Contact, ...]] = []
            arrays = stack(_noting(frames, touched), skin.shape)
            titles = OF_CIRCUIT if skin.knows_circuit else OF_COUNTS
        geometry = skin.geometry
    with whole_file(output) as file:
        if kind == ".nc":
            file.write(content)
        elif kind == ".npz":
            contacts = _contacts(touched)
            places = {"place_mm": geometry.places_mm, "area_mm2": geometry.areas_mm2}
            np.savez_compressed(file, allow_pickle=False, **arrays, **contacts, **places, time=arrays["host_time"])
        elif kind == ".csv":
            columns = _columns(arrays, titles, touched, geometry)
            file.write((",".join(columns) + "\n").encode())
            for row in zip(*columns.values(), strict=True):
                file.write((",".join(map(_text, row)) + "\n").encode())
        else:
            _write_parquet(_columns(arrays, titles, touched, geometry), file)
    if kind in TABLES and geometry.pitch_m is None:
        Shape.of(geometry).save(output.with_suffix(".shape.csv"))


def _noting(frames: Iterable[Frame], touched: list[tuple[Contact, ...]]) -> Iterator[Frame]:
    """The same frames, whose contacts are appended to ``touched`` as they pass."""
    for frame in frames:
        touched.append(frame.contacts)
        yield frame


def _contacts(touched: Sequence[tuple[Contact, ...]]) -> dict[str, AnyArray]:
    """The numbers of all contacts in a row, and the frame of each."""
    names = [item.name for item in fields(Contact) if item.name not in ("cells", "joined")]
    in_a_row = [contact for contacts in touched for contact in contacts]
    columns: dict[str, AnyArray] = {
        f"contact_{name}": np.array([np.nan if (value := getattr(one, name)) is None else value for one in in_a_row])
        for name in names
    }
    return columns | {"contact_frame": np.repeat(np.arange(len(touched)), [len(contacts) for contacts in touched])}


def _as_netcdf(frames: Iterable[Frame], skin: Skin) -> bytes:
    data = to_xarray(frames, skin)
    compressed = {name: {"zlib": True, "complevel": 4} for name in data.data_vars}
    try:
        return bytes(data.to_netcdf(engine="h5netcdf", encoding=compressed))
    except (ImportError, ValueError) as error:
        missing = [name for name in ("h5netcdf", "h5py") if find_spec(name) is None]
        if not missing:
            raise
        raise MissingExtra(f".nc files need {' and '.join(missing)}: {install_command('data')}") from error


def _columns(
    arrays: dict[str, AnyArray],
    titles: Mapping[str, str],
    touched: Sequence[tuple[Contact, ...]],
    geometry: Geometry,
) -> dict[str, AnyArray]:
    cells = np.argwhere(geometry.exists).tolist()
    columns = {name: arrays[name] for name in FRAME_NUMBERS}
    columns["contacts"] = np.array([len(contacts) for contacts in touched])
    columns["force_n"] = np.array([sum(contact.force_n for contact in contacts) for contacts in touched])
    for name, title in titles.items():
        columns |= {f"{title}_{r}_{c}": arrays[name][:, r, c] for r, c in cells}
    return columns


def _text(value: object) -> str:
    if isinstance(value, np.bool_):
        return str(int(value))
    if isinstance(value, np.floating):
        return "" if np.isnan(value) else str(int(value)) if value.is_integer() else repr(float(value))
    return str(value)


def _write_parquet(columns: dict[str, AnyArray], file: object) -> None:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingExtra(f".parquet needs pyarrow: {install_command('parquet')}") from error
    parquet.write_table(pyarrow.table({name: pyarrow.array(c, from_pandas=True) for name, c in columns.items()}), file)
