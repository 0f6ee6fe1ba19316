"""Kron reduction of any resistor network to its ports, by geometric nested dissection with substructures.

This serves networks that are not plain grids: bridged lines and the continuous sheet. The branches are halved by their
position, recursively, until a part has few of them. Each part is assembled, and all nodes that no branch outside the
part touches are eliminated. The two halves of a larger part are then joined in the same way.

The elimination uses the positive arithmetic of :mod:`._elimination`. Its accuracy therefore does not depend on how many
decades the resistances span. For a plain grid :func:`._ports.port_conductances` gives the same result faster.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ._elimination import ULP, Rounded, eliminate_leading
from ._tuning import IDEAL_WIRE, LARGEST_PART, MOST_BRANCHES


class Element(NamedTuple):
    """A part with more than two terminals, given by the conductances between them."""

    nodes: IntArray
    """(terminals,) nodes"""
    between: FloatArray
    """(..., terminals, terminals) S, zero on the diagonal"""
    relative: float = 0.0
    """bound on the relative error of ``between``"""


@dataclass(frozen=True)
class Network:
    """A resistor network: nodes, branches, elements and ports."""

    place: FloatArray
    """(nodes, axes) coordinates in any unit; they determine the order of elimination only"""
    ends: IntArray
    """(branches, 2) the nodes at the ends of each branch"""
    conductance: FloatArray
    """(..., branches) S; inf is a short, and 0 an open branch"""
    wire: BoolArray
    """(branches,) whether an infinite conductance is an ideal wire, which holds its potential even across a short"""
    ports: IntArray
    """(ports,) nodes"""
    elements: tuple[Element, ...] = ()


class _Part(NamedTuple):
    """Some branches and elements, reduced to the nodes that other branches or elements touch, and to ports."""

    nodes: IntArray
    touched: IntArray
    """(nodes,) number of branches and elements of the part that touch each node"""
    between: FloatArray
    """(..., nodes, nodes) S"""
    relative: FloatArray
    """(...,) bound on the relative error of ``between``"""


def reduce(network: Network) -> Rounded:
    """Kron reduction of a network to its ports.

    Returns:
        (..., ports, ports) S, zero on the diagonal, and bounds (...,) on the relative rounding errors.

    """
    conductance, elements = _capped(network)
    branches = len(network.ends)
    degree = np.bincount(network.ends.ravel(), minlength=len(network.place))
    for element in elements:
        degree[element.nodes] += 1
    is_port = np.zeros(len(network.place), dtype=np.bool_)
    is_port[network.ports] = True
    middles = [network.place[element.nodes].mean(axis=0) for element in elements]
    middle = np.concatenate([network.place[network.ends].mean(axis=1), *(place[None] for place in middles)])

    def leaf(lines: IntArray, whole: list[Element]) -> _Part:
        """Assemble a part from branches and elements."""
        nodes = np.unique(np.concatenate([network.ends[lines].ravel(), *(element.nodes for element in whole)]))
        between = np.zeros((*conductance.shape[:-1], len(nodes), len(nodes)))
        touched = np.zeros(len(nodes), dtype=np.intp)
        local = np.searchsorted(nodes, network.ends[lines])
        np.add.at(touched, local, 1)
        for (a, b), line in zip(local.tolist(), lines.tolist(), strict=True):
            between[..., a, b] += conductance[..., line]
        between += np.swapaxes(between, -1, -2)
        for element in whole:
            at = np.searchsorted(nodes, element.nodes)
            touched[at] += 1
            between[..., at[:, None], at] += element.between
        relative = max((element.relative for element in whole), default=0.0) + ULP * (len(lines) + len(whole))
        return _Part(nodes, touched, between, np.full(between.shape[:-2], relative))

    def part(items: IntArray) -> _Part:
        """Reduce some items, recursively by halves. Items below ``branches`` are branches, the others elements."""
        among = items[items >= branches] - branches
        if len(items) == 1 or (len(items) <= MOST_BRANCHES and len(among) <= 1):
            return without_inner(leaf(items[items < branches], [elements[k] for k in among]))
        axis = int(np.argmax(np.ptp(middle[items], axis=0)))
        order = items[np.argsort(middle[items, axis], kind="stable")]
        halves = [part(order[: len(order) // 2]), part(order[len(order) // 2 :])]
        nodes = np.union1d(halves[0].nodes, halves[1].nodes)
        touched = np.zeros(len(nodes), dtype=np.intp)
        between = np.zeros((*conductance.shape[:-1], len(nodes), len(nodes)))
        for half in halves:
            at = np.searchsorted(nodes, half.nodes)
            touched[at] += half.touched
            between[..., at[:, None], at] += half.between
        relative = np.maximum(halves[0].relative, halves[1].relative) + ULP
        return without_inner(_Part(nodes, touched, between, relative))

    def without_inner(whole: _Part) -> _Part:
        """Eliminate the nodes that are no ports and have all their branches and elements in this part."""
        done = (whole.touched == degree[whole.nodes]) & ~is_port[whole.nodes]
        gone = int(done.sum())
        if not gone:
            return whole
        order = np.argsort(~done, kind="stable")
        kept = order[gone:]
        between, relative = eliminate_leading(whole.between[..., order[:, None], order], gone)
        return _Part(whole.nodes[kept], whole.touched[kept], between, whole.relative + relative)

    whole = part(np.arange(branches + len(elements)))
    order = np.argsort(whole.nodes)
    at = order[np.searchsorted(whole.nodes, network.ports, sorter=order)]
    return Rounded(whole.between[..., at[:, None], at], whole.relative)


def _capped(network: Network) -> tuple[FloatArray, list[Element]]:
    """Replace infinite conductances by large finite ones.

    A short exceeds every finite conductance by the factor :data:`._tuning.IDEAL_WIRE`, and an ideal wire exceeds a
    short by the same factor.

    Returns:
        (..., branches) S, and the elements.

    """
    largest = max(
        float(np.max(values, where=np.isfinite(values), initial=LARGEST_PART))
        for values in (network.conductance, *(element.between for element in network.elements))
    )
    short = IDEAL_WIRE * largest
    conductance = np.minimum(network.conductance, np.where(network.wire, IDEAL_WIRE * short, short))
    return conductance, [part._replace(between=np.minimum(part.between, short)) for part in network.elements]
