"""Tolerances as factors, and the Monte Carlo analysis against itself."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from designs import amplifier

from ohmskin.circuits import Array, Design, Requirement
from ohmskin.errors import MissingExtra
from ohmskin.verification import prototype, verify


@pytest.mark.parametrize(("distribution", "mean"), [("uniform", 0.5), ("normal", 0.26), ("two-point", 1.0)])
def test_distributions_have_their_width(distribution: str, mean: float) -> None:
    """Of an offset that alone makes the error of one cell: the mean magnitude over the largest one."""
    offset = {"nominal": 0.0, "deviation": 1e-4, "distribution": distribution}
    cells = {"rest_resistance": 1e4, "full_scale_resistance": 2e4}
    design = amplifier(1, 1).replace(readout={"offset_voltage": offset}, cells=cells)
    (sampled, worst) = verify(
        design,
        requirements=[*SAMPLED, Requirement(id="W", quantity="reading_error", max=4.0)],
        samples=2000,
    ).results
    assert sampled.measurement is not None
    assert worst.measurement is not None
    values = np.array(sampled.measurement.samples) / worst.measurement.value
    assert values.max() <= 1.0 + 1e-12
    assert values.mean() == pytest.approx(mean, rel=0.05)


SAMPLED = [Requirement(id="Y", quantity="reading_error", max=4.0, method="monte-carlo")]


def _samples(**keys: object) -> tuple[float, ...]:
    (result,) = verify(prototype(), requirements=SAMPLED, samples=250, **keys).results  # type: ignore[arg-type]
    assert result.measurement is not None
    return tuple(result.measurement.samples)


def test_samples_do_not_depend_on_who_computes_them(tmp_path: Path) -> None:
    alone = _samples()
    assert len(alone) == 250
    with ThreadPoolExecutor(3) as executor:
        assert _samples(executor=executor) == alone
    assert _samples(seed=2) != alone


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    alone = _samples()

    def stop(done: int, total: int, what: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    report = verify(prototype(), requirements=SAMPLED, samples=250, store=tmp_path / "partial", progress=stop)
    assert report.interruption is not None
    assert report.results[0].outcome == "not run"
    assert "stopped" in report.results[0].why
    stored = list((tmp_path / "partial").rglob("*.json"))
    assert len(stored) == 2
    drawn: list[str] = []
    assert _samples(store=tmp_path / "partial", progress=lambda done, total, what: drawn.append(what)) == alone
    assert [what for what in drawn if what.startswith("boards")] == ["boards 201 to 300"]
    assert not list((tmp_path / "partial").rglob("*.json")) or not (tmp_path / "partial").exists()


def test_a_board_without_a_reading_is_a_failed_board() -> None:
    design = prototype().replace(readout={"supply": (0.0, 1.951)})
    (result,) = verify(design, requirements=SAMPLED, samples=100).results
    assert result.measurement is not None
    lost = sum(not np.isfinite(value) for value in result.measurement.samples)
    assert 0 < lost <= 100
    assert len(result.measurement.samples) == 100
    assert result.outcome == "fail"


def test_samples_are_exported(tmp_path: Path) -> None:
    report = verify(prototype(), requirements=SAMPLED, samples=100)
    report.export(tmp_path / "boards.csv")
    assert (tmp_path / "boards.csv").read_text().startswith("board,Y\n0.0,")
    for kind in ("parquet", "nc"):
        try:
            report.export(tmp_path / f"boards.{kind}")
        except MissingExtra:
            pytest.skip("the extra 'data' is not installed")
    pandas, xarray = pytest.importorskip("pandas"), pytest.importorskip("xarray")
    values = report.results[0].measurement.samples  # type: ignore[union-attr]
    assert tuple(pandas.read_parquet(tmp_path / "boards.parquet")["Y"]) == values
    with xarray.open_dataset(tmp_path / "boards.nc", engine="scipy") as data:
        assert tuple(data["Y"].values) == values
        assert data["Y"].units == "%"


def test_continuous_sheets_are_not_run_rather_than_guessed() -> None:
    design = Design.model_validate(
        amplifier(2, 2).model_dump() | {"array": Array(rows=2, columns=2, sheet="continuous")}
    )
    (result,) = verify(design, requirements=[Requirement(id="C", quantity="crosstalk", max=1.0)]).results
    assert result.outcome == "not run"
    assert "no worst case" in result.reason


def _worst(design: Design) -> Any:
    asked = [Requirement(id="W", quantity="reading_error", max=90.0)]
    record = verify(design, requirements=asked).record().requirements[0]
    assert record.corner is not None
    return record


def test_lines_of_one_package_deviate_together() -> None:
    """The mates of the worst resistor differ from it by no more than they match; other packages are their own.

    A deviation in ohm is each resistor's own, too.
    """
    spread = {"nominal": 1e3, "tolerance": 0.05, "deviation": 3.0, "matching": 0.001, "package": 2}
    cells = {"rest_resistance": 1e4, "full_scale_resistance": 2e4}
    record = _worst(amplifier(1, 4).replace(readout={"reference_resistance": spread}, cells=cells))
    values = np.array(record.corner.parts["readout.reference_resistance"]).reshape(2, 2) / 1e3 - 1
    place = record.corner.cell[1]
    assert abs(values.ravel()[place]) == pytest.approx(0.05 + 0.003)
    assert abs(np.diff(values[place // 2])[0]) <= 0.008 + 1e-12
    assert np.abs(values[1 - place // 2]).max() <= 0.008


def test_temperature_moves_all_parts_together() -> None:
    """A reference resistor that grows as its row's lead and cell do reads the same at every temperature."""
    lead = {"nominal": 1e4, "temperature_coefficient": 0.004}
    cells = {"rest_resistance": 1e4, "full_scale_resistance": 1e4 + 1e-6}
    alone = amplifier(1, 1).replace(array={"row_lead": lead}, operation={"temperature_range": (278.15, 338.15)})
    alone = alone.replace(cells=cells)
    both = alone.replace(readout={"reference_resistance": {"nominal": 1e3, "temperature_coefficient": 0.002}})
    never = both.replace(array={"row_lead": 1e4}, readout={"reference_resistance": 1e3})
    same, one, none = (_worst(design).measured for design in (both, alone, never))
    assert same == pytest.approx(none, rel=0.03)
    assert one > 1.1 * none
