"""Regression scenarios: the table is that of this source, figures are what their names say, and gates are limits."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from ohmskin.bench import scenarios, scenes
from ohmskin.bench.harness import interval_score
from ohmskin.cell import Cell
from ohmskin.cli import run

FROZEN = (
    "taps | example, 100 Hz, 12 bits, 1 mV",
    "random | paper, 100 Hz, 12 bits, 1 mV",
    "press, opens | example, 100 Hz, 12 bits, 1 mV",
    "wavering | example, 100 Hz, 12 bits, 1 mV",
    "hold | example, 100 Hz, 8 bits, 0.1 mV",
    "taps, mismatched | example, 100 Hz, 12 bits, 1 mV",
)


class Knows:
    """Shows the truth, off by so many of its own deviations."""

    def __init__(self, cell: Cell, shape: tuple[int, ...], off: float = 0.5) -> None:
        self.played: scenes.Played | None = None
        self.frame, self.off = -1, off
        self.std_kpa = np.full(shape, 0.01 * cell.full_scale_kpa)

    def step(self, elapsed_s: float, resistance: np.ndarray) -> np.ndarray:
        assert self.played is not None
        self.frame += 1
        np.testing.assert_array_equal(resistance, self.played.ohms[self.frame])
        return np.asarray(self.played.pressure_kpa[self.frame] + self.off * self.std_kpa)


@pytest.mark.parametrize("name", FROZEN)
def test_the_table_holds_for_this_source(name: str) -> None:
    """No limit is missed that the frozen figures met."""
    row = next(row for row in scenarios.rows(name) if row.name == name)
    (verdict,) = scenarios.judge([row], scenarios.maker(None))
    assert row.today is not None
    assert set(verdict.misses) <= set(scenarios.misses(row, row.today))


def test_figures_are_those_of_an_estimator_whose_errors_are_known() -> None:
    """Half a deviation off everywhere, of one percent of full scale."""
    scene = scenes.Scene("taps", "example")
    cell, played = scenes.cells()["example"], scenes.play(scene)
    estimator = Knows(cell, played.pressure_kpa.shape[1:])
    estimator.played = played
    pressure, std, _ = scenarios.estimated(played, estimator)
    found = scenarios.figures(played, pressure, std, cell.full_scale_kpa)
    assert (found.rmse, found.interval, found.sd, found.rest) == pytest.approx((0.5, 4.0, 1.0, 0.5))
    assert found.within == 100.0


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({}, ()),
        ({"rmse": 0.55}, ()),  # 1.25 times today's, and 0.3 % of full scale
        ({"rmse": 0.6}, ("rmse",)),
        ({"within": 87.0}, ("within",)),
        ({"interval": 7.0, "sd": 9.0}, ("interval",)),
        ({"rest": 11.0}, ("rest",)),
        ({"interval": math.nan}, ("interval",)),
        ({"rest": math.nan}, ()),  # no cell is released
    ],
)
def test_a_gate_names_the_figures_that_miss_it(change: dict[str, float], missed: tuple[str, ...]) -> None:
    gate = scenarios.Gate(
        rmse_percent=0.3, rmse_times_today=1.25, within_percent=88, interval_times_today=1.5, rest_percent=10
    )
    today = scenarios.Figures(rmse=0.2, within=99.0, interval=4.0, sd=1.0, rest=0.05)
    row = scenarios.Row("", "", gate, today, None, quick=False)
    assert scenarios.misses(row, replace(today, **change)) == missed


@given(st.floats(0.1, 10.0), st.floats(1.05, 3.0), st.booleans())
def test_the_interval_score_is_least_for_the_deviation_that_is_true(std: float, factor: float, wide: bool) -> None:
    """Of normal errors; the least lies where the interval has 95 %, which is 1.96 deviations to a side."""
    error = std * np.asarray(norm.ppf((np.arange(20_000) + 0.5) / 20_000))
    stated = np.full_like(error, 1.96 / 2.0 * std)
    assert interval_score(error, stated) < interval_score(error, stated * (factor if wide else 1.0 / factor))


def test_a_cell_that_the_converter_cannot_tell_from_an_open_one_reads_infinite() -> None:
    played = scenes.play(scenes.Scene("rest", "fsr", noise_mv=0.0))
    assert np.isinf(played.ohms).all()


def test_rows_are_chosen_by_name_and_gate(capsys: pytest.CaptureFixture[str]) -> None:
    assert {row.gate for row in scenarios.rows("vibration")} >= {"hard"}
    assert run(["bench", "--scenarios", "--only", "rest | contact", "--json"]) == 0
    (verdict,) = json.loads(capsys.readouterr().out)
    assert verdict["name"] == "rest | contact, 100 Hz, 12 bits, 1 mV"
    assert verdict["limits"]["within"] == 88.0
    assert run(["bench", "--scenarios", "--only", "no such row"]) == 2
    assert run(["bench", "--scenarios", "--estimator", "ohmskin.cell:nobody"]) == 2
