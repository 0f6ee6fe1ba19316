"""The boards of a Monte Carlo analysis as a table for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..common.extras import install_command
from ..common.files import whole_file
from ..common.tables import write_columns
from ..errors import InputError, MissingExtra
from ._outcome import Result


def export_samples(results: Sequence[Result], path: str | Path) -> None:
    """One row per board, one column per sampled requirement.

    Args:
        results: of a run.
        path: ends with .parquet, .nc or .csv.

    Raises:
        InputError: nothing was sampled, another kind of file, or it cannot be written.
        MissingExtra: the extra ``data`` is not installed.
    """
    columns = {
        r.requirement.id: list(r.measurement.samples)
        for r in results
        if r.measurement is not None and r.measurement.samples
    }
    if not columns:
        raise InputError(
            f"{path}: no requirement was verified by the method 'monte-carlo'; there are no boards to export"
        )
    units = {r.requirement.id: r.unit for r in results}
    quantities = {r.requirement.id: r.requirement.quantity for r in results}
    count = min(map(len, columns.values()))
    kind = Path(path).suffix
    if kind == ".csv":
        write_columns(path, {"board": [float(k) for k in range(count)], **columns})
        return
    try:
        import xarray
    except ImportError as error:
        raise MissingExtra(f"{kind} files need xarray: {install_command('data')}") from error
    data = xarray.Dataset(
        {
            name: ("board", values, {"units": units[name], "quantity": quantities[name]})
            for name, values in columns.items()
        },
        coords={"board": range(count)},
    )
    try:
        if kind == ".parquet":
            with whole_file(path) as file:
                data.to_dataframe().to_parquet(file)
        elif kind == ".nc":
            content = data.to_netcdf(engine="scipy")
            with whole_file(path) as file:
                file.write(bytes(content))
        else:
            raise InputError(f"{path}: expected a file name that ends with .parquet, .nc or .csv")
    except ImportError as error:
        raise MissingExtra(f"{kind} files need another package: {install_command('data')}: {error}") from error
