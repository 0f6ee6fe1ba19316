"""Eliminating nodes from resistive networks in positive arithmetic, and how far rounding can have moved the rest.

Eliminating a node joins its neighbours a, b by g_a g_b / sum(g) (star-mesh). Only conductances are kept, never the
diagonal of the nodal matrix: every result is a sum of products and quotients of nonnegative numbers, so each entry is
accurate to a few ulp times the depth of the computation, however many decades the resistances span (the argument of
Grassmann, Taksar and Heyman for Markov chains).

Many nodes at once go as one dense block (LAPACK inverse). That block is a diagonally dominant M-matrix; where it is
close to singular (strongly tied nodes, weakly tied to the rest) the inverse would lose digits, which
diag(A) diag(A^-1) shows. Those blocks are inverted by halves, which never subtracts and so never loses any.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from ...arrays import FloatArray

SAFE_GROWTH = 1e3  # diag(A) diag(A^-1) beyond which a block is inverted by halves
ULP = float(np.finfo(np.float64).eps) / 2.0
_SUM_OF_GROWTHS = 8  # nodes up to which a rounding bound is not worth another matrix product


class Meter:
    """Adds up how far rounding can have moved the conductances of a network, relative to each of them."""

    def __init__(self) -> None:
        self.relative = 0.0


class _Meters(threading.local):
    def __init__(self) -> None:
        self.current: Meter | None = None


_meters = _Meters()


@contextmanager
def rounding_meter() -> Iterator[Meter]:
    """Measure the rounding errors of all eliminations in the block (of this thread).

    Every elimination is accounted for as if it had been exact, but each conductance it leaves had then been changed by
    at most a relative e (see :func:`_rounding`). A change of all conductances of a network by at most e changes the
    current at port i for 1 V at port j by at most e sqrt(Y_ii Y_jj), Y_ii the conductance of port i against all others
    at ground: by Tellegen's theorem it is the sum of e g dv_i dv_j over all branches, and that of g dv_i^2 is Y_ii. It
    does not matter at which stage of the elimination the network is looked at, so the e of successive stages add up,
    while of blocks that lie side by side only the largest counts.
    """
    outer, _meters.current = _meters.current, Meter()
    try:
        yield _meters.current
    finally:
        _meters.current = outer


def eliminate_leading(network: FloatArray, count: int) -> FloatArray:
    """Remove the first ``count`` nodes from stacked networks (..., n, n) of conductances (S, zero diagonal).

    Returns (..., n - count, n - count), symmetric with zero diagonal. Nodes that nothing touches just go.
    """
    gone, kept = slice(0, count), slice(count, None)
    across = network[..., gone, kept]
    inner = impedance(network[..., gone, gone], across.sum(axis=-1), across.shape[-1])
    result = np.swapaxes(across, -1, -2) @ (inner @ across)
    result += network[..., kept, kept]
    np.einsum("...ii->...i", result)[...] = 0.0
    return result


def impedance(between: FloatArray, to_ground: FloatArray, ports: int = 1) -> FloatArray:
    """Impedance matrices (..., n, n) in ohm of n nodes: volts at each for a unit current into each.

    Args:
        between: (..., n, n) S between the nodes, zero on the diagonal.
        to_ground: (..., n) S from each node to ground. Nodes that nothing ties to ground may stand at any
            potential; theirs is set by an arbitrary conductance.
        ports: how many conductances ``to_ground`` is the sum of.

    """
    inverse, relative = inverted(between, between.sum(axis=-1) + to_ground, to_ground[..., None], ports)
    account(float(relative.max(initial=0.0)))
    return inverse


def inverted(between: FloatArray, total: FloatArray, across: FloatArray, ports: int) -> tuple[FloatArray, FloatArray]:
    """:func:`impedance`, and a bound (...,) on the relative error of any conductance that elimination by it leaves.

    Args:
        between: (..., n, n) S between the nodes, zero on the diagonal.
        total: (..., n) S at each node; zeros become 1.
        across: (..., n, any) S from each node to others, which together are its conductance to ground.
        ports: how many conductances that is the sum of.

    """
    nodes = between.shape[-1]
    if not total.all():
        total[total == 0] = 1.0
    matrix = -between
    np.einsum("...ii->...i", matrix)[...] = total
    try:
        inverse: FloatArray = np.linalg.inv(matrix).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        inverse = np.full(between.shape, np.nan)
    growth = np.einsum("...ii->...i", inverse) * total  # at least 1, were it exact
    if growth.min(initial=1.0) > 0.5 and growth.max(initial=1.0) <= SAFE_GROWTH:
        return inverse, _rounding(inverse, total, growth, ports)
    suspect = ~((growth > 0.5) & (growth <= SAFE_GROWTH)).all(axis=-1)
    relative: FloatArray = np.full(total.shape[:-1], ULP * 6.0 * nodes * (nodes + ports))
    relative[~suspect] = _rounding(inverse[~suspect], total[~suspect], growth[~suspect], ports)
    inverse[suspect] = _by_halves(between[suspect], across[suspect].sum(axis=-1))
    return inverse, relative


def account(relative: float) -> None:
    """Tell the meter of this thread, if there is one."""
    if _meters.current is not None:
        _meters.current.relative += relative


def _rounding(inverse: FloatArray, total: FloatArray, growth: FloatArray, ports: int) -> FloatArray:
    """Bound (...,) on the relative error of any conductance that an elimination through ``inverse`` leaves.

    LU with its two triangular solves is exact for a matrix within 3 gamma_n |L||U| of the given one (Higham, Accuracy
    and Stability, theorem 9.4); the diagonal itself carries the rounding of its sum. The factors of an M-matrix are
    M-matrices, so |L| = 2 - L and |U| = 2 diag(U) - U, and with Z = U^-1 L^-1, all of it nonnegative,
    Z |L||U| Z = 4 Z diag(U) Z - 2 Z L^-1 - 2 U^-1 diag(U) Z + Z <= 4 Z diag(total) Z. What that is relative to
    Z_ij is computed, or for small blocks bounded by the sum of the growths, since Z_ik Z_kj <= Z_ij Z_kk in an inverse
    M-matrix. The two products with Z then add gamma_n each, being sums of nonnegative numbers.
    """
    nodes: int = inverse.shape[-1]
    if nodes <= _SUM_OF_GROWTHS:
        amplification: FloatArray = growth.sum(axis=-1)
    else:
        twice = (inverse * total[..., None, :]) @ inverse
        np.divide(twice, inverse, out=twice, where=inverse > 0)
        amplification = twice.max(axis=(-2, -1))
    amplification *= ULP * (13.0 * nodes + ports)
    amplification += ULP * (2.0 * nodes + 4.0)
    return amplification


def _by_halves(between: FloatArray, to_ground: FloatArray) -> FloatArray:
    """:func:`impedance` without a single subtraction: the first half of the nodes is eliminated, which adds to the
    conductances of the second half; that half's impedance then gives the first half's.
    """
    nodes = between.shape[-1]
    if nodes == 1:
        return 1.0 / np.where(to_ground == 0, 1.0, to_ground)[..., None]
    one, other = slice(0, nodes // 2), slice(nodes // 2, None)
    across = between[..., one, other]
    own = _by_halves(between[..., one, one], to_ground[..., one] + across.sum(axis=-1))
    share = own @ across  # volts at the first half for 1 V at a node of the second
    added = np.swapaxes(across, -1, -2) @ share
    np.einsum("...ii->...i", added)[...] = 0.0
    leak = (np.swapaxes(share, -1, -2) @ to_ground[..., one, None])[..., 0]
    rest = _by_halves(between[..., other, other] + added, to_ground[..., other] + leak)
    result = np.empty_like(between)
    result[..., other, other] = rest
    result[..., one, other] = share @ rest
    result[..., other, one] = np.swapaxes(result[..., one, other], -1, -2)
    result[..., one, one] = own + result[..., one, other] @ np.swapaxes(share, -1, -2)
    return result
