"""The exact lags against closed forms and an ordinary differential equation solver."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from ohmskin.cell.materials import _lag as lag

seconds = st.floats(1e-4, 1e4)
values = st.floats(-10, 10)


@given(exponent=st.floats(-12, 3))
def test_weights_keep_full_precision(exponent: float) -> None:
    z = 10.0**exponent
    gone, ramp = lag.weights(z, 1.0)
    with mpmath.workdps(40):
        exact_gone = -mpmath.expm1(-mpmath.mpf(z))
        exact_ramp = 1 - exact_gone / mpmath.mpf(z)
    assert float(gone) == pytest.approx(float(exact_gone), rel=4e-16)
    assert float(ramp) == pytest.approx(float(exact_ramp), rel=1e-12)


@given(x=values, u0=values, u1=values, dt=seconds, up=seconds, down=seconds, cut=st.floats(0.01, 0.99))
def test_a_step_cut_in_two_is_the_same_step(
    x: float, u0: float, u1: float, dt: float, up: float, down: float, cut: float
) -> None:
    x0, a, b = np.array(x), np.array(u0), np.array(u1)
    middle = a + (b - a) * cut
    for step in (
        lambda x, a, b, dt: lag.symmetric(x, a, b, dt, up),
        lambda x, a, b, dt: lag.asymmetric(x, a, b, dt, up, down),
    ):
        whole = step(x0, a, b, dt)
        parts = step(step(x0, a, middle, dt * cut), middle, b, dt * (1 - cut))
        assert parts == pytest.approx(whole, abs=1e-9)


@pytest.mark.parametrize(("x", "u0", "u1"), [(0.8, 0.0, 2.0), (0.2, 1.0, -1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.5)])
def test_the_asymmetric_lag_solves_its_equation(x: float, u0: float, u1: float) -> None:
    dt, up, down = 3.0, 0.4, 5.0

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        w = u0 + (u1 - u0) * t / dt - y
        return np.where(w > 0, w / up, w / down)

    reference = solve_ivp(slope, (0, dt), [x], rtol=1e-10, atol=1e-12, max_step=0.01).y[0, -1]
    stepped = lag.asymmetric(np.array([x]), np.array([u0]), np.array([u1]), dt, up, down)
    assert stepped[0] == pytest.approx(reference, abs=1e-6)


def test_a_constant_is_a_fixed_point_for_a_week_of_samples() -> None:
    """Exactly so: x = u stays u whatever the ratio of step and time constant."""
    x = np.array([0.1, 1 / 3, 7.7])
    for dt in (1e-4, 1e-2, 1.0):
        for constant in (1e-3, 10.0, 3600.0):
            assert (lag.symmetric(x, x, x, dt, constant) == x).all()
            assert (lag.asymmetric(x, x, x, dt, constant, 2 * constant) == x).all()


def test_no_time_changes_nothing() -> None:
    x, u0, u1 = np.array([0.5]), np.array([0.0]), np.array([2.0])
    assert lag.symmetric(x, u0, u1, 0.0, 3.0) == x
    assert lag.asymmetric(x, u0, u1, 0.0, 1.0, 3.0) == x
