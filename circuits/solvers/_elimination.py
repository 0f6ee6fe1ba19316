"""Kron reduction of resistive networks (Schur complements of M-matrices) without loss of digits, and its error bound.

**Star-mesh transformation.** Eliminating a node joins each pair of its neighbours a, b by the conductance
g_a g_b / sum(g). We keep conductances only, never the diagonal of the nodal matrix. Every result is then a sum of
products and quotients of nonnegative numbers, and no digits cancel, however many decades the resistances span. This is
the algorithm of Grassmann, Taksar and Heyman (Operations Research 33, 1985), known from Markov chains.

**Many nodes at once** are one dense block A, whose inverse LAPACK computes by LU. LU does subtract, on the diagonal.
We therefore use LU only where at least :data:`SAFE_SHARE` of the conductance of every node leads to nodes outside the
block. A Schur complement of a diagonally dominant M-matrix keeps this conductance to the outside. Two
properties follow, and the error analysis (:func:`_lu_rounding`) needs both:

* No pivot falls below :data:`SAFE_SHARE` of the diagonal, so that few digits are lost.
* Each pivot exceeds every entry below it by more than rounding can change, so that partial pivoting never interchanges
  rows.

**All other blocks** are inverted by halves (:func:`_by_halves`). Eliminating one half increases the conductance from
the other half to the outside. The recursion ends, at the latest, with single nodes, and it never subtracts.

**The error bound.** A rounded elimination equals an exact one after which each remaining conductance is multiplied by
1 + e, with a known bound on abs(e), the *relative error*. Changing every conductance of a network by at most e changes
the current at port i for 1 V at port j by at most e sqrt(Y_ii Y_jj), where Y_ii is the conductance of port i with all
other ports at ground. Proof: by Tellegen's theorem the change is the sum of e g dv_i dv_j over all branches, the sum of
g dv_i^2 is Y_ii, and the Cauchy-Schwarz inequality does the rest. This holds at every stage of an elimination with the
same Y, so relative errors of successive stages add up. Of blocks that are eliminated side by side, only the largest
relative error counts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from ._tuning import SAFE_SHARE, SUM_OF_GROWTHS

ULP = float(np.finfo(np.float64).eps) / 2.0


class Rounded(NamedTuple):
    """Result of an elimination, and a bound on its rounding errors."""

    value: FloatArray
    """(..., n, n) conductances in S or impedances in ohm"""
    relative: FloatArray
    """(...,) bound on the relative error of all conductances of each network, as the module defines it"""


def eliminate_leading(network: FloatArray, count: int) -> Rounded:
    """Kron reduction: eliminate the first ``count`` nodes of each network.

    Args:
        network: (..., n, n) S between the nodes, symmetric with zero diagonal.
        count: number of nodes to eliminate. Isolated nodes among them are dropped.

    Returns:
        (..., n - count, n - count) S, symmetric with zero diagonal.

    """
    gone, kept = slice(0, count), slice(count, None)
    across = network[..., gone, kept]
    inverse, relative = inverted(network[..., gone, gone], across.sum(axis=-1), across.shape[-1])
    result = np.swapaxes(across, -1, -2) @ (inverse @ across)
    result += network[..., kept, kept]
    np.einsum("...ii->...i", result)[...] = 0.0
    return Rounded(result, relative)


def inverted(between: FloatArray, to_ground: FloatArray, ports: int = 1) -> Rounded:
    """Impedance matrices: volts at each node for 1 A into each node, the inverses of nodal matrices.

    Args:
        between: (..., n, n) S between the nodes, zero on the diagonal.
        to_ground: (..., n) S from each node to nodes outside, all of them at ground. The potential of an island of
            nodes without such a conductance is arbitrary; 1 S from one of its nodes to ground then sets it.
        ports: number of conductances that each entry of ``to_ground`` is the sum of.

    Returns:
        (..., n, n) ohm, and a bound on the relative error of the conductances after an elimination by these matrices.

    """
    total = np.einsum("...ij->...i", between)  # three times as fast as sum() on small stacks
    total += to_ground
    fits = to_ground >= SAFE_SHARE * total
    if not total.all():
        total[total == 0] = 1.0
    if fits.all() or between.shape[-1] == 1:
        return _by_lu(between, total, ports)
    fits = fits.all(axis=-1)
    value, relative = np.empty(between.shape), np.empty(total.shape[:-1])
    if fits.any():
        value[fits], relative[fits] = _by_lu(between[fits], total[fits], ports)
    value[~fits], relative[~fits] = _by_halves(between[~fits], to_ground[~fits], ports)
    return Rounded(value, relative)


def _by_lu(between: FloatArray, total: FloatArray, ports: int) -> Rounded:
    """Invert by LAPACK's LU. ``total`` (..., n) S is each node's conductance to all others and to ground, not zero."""
    matrix = -between
    np.einsum("...ii->...i", matrix)[...] = total
    inverse: FloatArray = np.linalg.inv(matrix).astype(np.float64, copy=False)
    return Rounded(inverse, _lu_rounding(inverse, total, ports))


def _lu_rounding(inverse: FloatArray, total: FloatArray, ports: int) -> FloatArray:
    """Bound (...,) on the relative error of any conductance after an elimination by ``inverse``.

    LU without interchanges, and its two triangular solves, give the inverse of a matrix within 3 gamma_n |L||U| of the
    given one (Higham, Accuracy and Stability of Numerical Algorithms, theorem 9.4). The diagonal of the given matrix
    carries the rounding of a sum. The computed factors have the signs of the factors of an M-matrix: off the diagonal
    they are sums of terms of one sign, and the pivots are positive by the condition for LU. So |L| = 2 - L and
    |U| = 2 diag(U) - U. With Z = U^-1 L^-1, which has no negative entry,

        Z |L||U| Z = 4 Z diag(U) Z - 2 Z L^-1 - 2 U^-1 diag(U) Z + Z <= 4 Z diag(total) Z.

    We compute the largest ratio of (Z diag(total) Z)_ij to Z_ij. For small blocks we bound this ratio by the sum of the
    growths total_k Z_kk, since Z_ik Z_kj <= Z_ij Z_kk in an inverse M-matrix. The two products with Z that follow are
    sums of nonnegative numbers, and add gamma_n each.
    """
    nodes: int = inverse.shape[-1]
    if nodes <= SUM_OF_GROWTHS:
        amplification: FloatArray = (np.einsum("...ii->...i", inverse) * total).sum(axis=-1)
    else:
        twice = (inverse * total[..., None, :]) @ inverse
        np.divide(twice, inverse, out=twice, where=inverse > 0)
        amplification = twice.max(axis=(-2, -1))
    amplification *= ULP * (13.0 * nodes + ports)
    amplification += ULP * (2.0 * nodes + 4.0)
    return amplification


def _by_halves(between: FloatArray, to_ground: FloatArray, ports: int) -> Rounded:
    """Invert by block elimination of one half of the nodes, then the other; arguments as for :func:`inverted`.

    For the first half, conductances to the second half count as conductances to ground. The Schur complement of the
    first half is formed in positive arithmetic: as conductances between the nodes of the second half, and from these
    nodes to ground.
    """
    nodes = between.shape[-1]
    one, other = slice(0, nodes // 2), slice(nodes // 2, None)
    across = between[..., one, other]
    own, first = inverted(between[..., one, one], to_ground[..., one] + across.sum(axis=-1), ports + nodes)
    share = own @ across  # volts at the first half for 1 V at a node of the second
    added = np.swapaxes(across, -1, -2) @ share
    np.einsum("...ii->...i", added)[...] = 0.0
    leak = (np.swapaxes(share, -1, -2) @ to_ground[..., one, None])[..., 0]
    rest, second = inverted(between[..., other, other] + added, to_ground[..., other] + leak, ports + nodes)
    result = np.empty(between.shape)
    result[..., other, other] = rest
    result[..., one, other] = share @ rest
    result[..., other, one] = np.swapaxes(result[..., one, other], -1, -2)
    result[..., one, one] = own + result[..., one, other] @ np.swapaxes(share, -1, -2)
    # Two stages, one after the other; the products that join their impedances add a few gamma_n of nonnegative sums.
    return Rounded(result, first + second + ULP * (6.0 * nodes + ports))
