"""Tolerances as factors, and the Monte Carlo analysis against itself."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from designs import amplifier
from scipy.stats import binom

from ohmskin.circuits import Array, Design, Requirement
from ohmskin.errors import MissingExtra
from ohmskin.verification import prototype, verify
from ohmskin.verification._export import export_samples
from ohmskin.verification._montecarlo import proportion_bounds
from ohmskin.verification._parameters import Factors


def test_matching_keeps_the_lines_of_a_package_together() -> None:
    spread = {"nominal": 1e3, "tolerance": 0.05, "matching": 0.001, "package": 2}
    factors = Factors.of(amplifier(2, 4).replace(readout={"reference_resistance": spread}))
    drawn = factors.sample(np.random.default_rng(1), 500)
    values = factors.values("readout.reference_resistance", drawn) / 1e3 - 1
    assert np.abs(values).max() <= 0.05
    assert np.abs(values[:, 0] - values[:, 1]).max() <= 0.002
    assert np.abs(values[:, 1] - values[:, 2]).max() > 0.02


def test_temperature_moves_all_parts_together() -> None:
    lead = {"nominal": 50.0, "temperature_coefficient": 0.004}
    design = amplifier(2, 2).replace(array={"row_lead": lead}, operation={"temperature_range": (278.15, 338.15)})
    factors = Factors.of(design)
    assert [factor.name for factor in factors.factors] == ["temperature"]
    cold, hot = (factors.values("array.row_lead", np.array([[x]])).ravel() for x in (-1.0, 1.0))
    assert cold == pytest.approx(50 * (1 - 0.004 * 20))
    assert hot == pytest.approx(50 * (1 + 0.004 * 40))


@pytest.mark.parametrize(("distribution", "deviation"), [("uniform", 3**-0.5), ("normal", 0.33), ("two-point", 1.0)])
def test_distributions_have_their_width(distribution: str, deviation: float) -> None:
    spread = {"nominal": 0.0, "deviation": 1.0, "distribution": distribution}
    factors = Factors.of(amplifier(2, 2).replace(readout={"offset_voltage": spread}))
    values = factors.values("readout.offset_voltage", factors.sample(np.random.default_rng(2), 4000))
    assert np.abs(values).max() <= 1.0
    assert values.std() == pytest.approx(deviation, rel=0.03)


@pytest.mark.parametrize(("kept", "count"), [(0, 10), (7, 10), (10, 10), (995, 1000)])
def test_bounds_of_a_yield_are_those_of_clopper_and_pearson(kept: int, count: int) -> None:
    low, high = proportion_bounds(kept, count)
    if kept:
        assert binom.sf(kept - 1, count, low) == pytest.approx(0.025)
    if kept < count:
        assert binom.cdf(kept, count, high) == pytest.approx(0.025)
    assert low <= kept / count <= high


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

    with pytest.raises(KeyboardInterrupt):
        _samples(store=tmp_path / "partial", progress=stop)
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
    export_samples(report.results, tmp_path / "boards.csv")
    assert (tmp_path / "boards.csv").read_text().startswith("board,Y\n0.0,")
    for kind in ("parquet", "nc"):
        try:
            export_samples(report.results, tmp_path / f"boards.{kind}")
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
