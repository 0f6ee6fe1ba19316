"""Any resistor network reduced to its ports: what a plain grid is not (bridged lines, the continuous sheet).

The same positive arithmetic as :mod:`._ports`, so the same accuracy whatever the resistances span, but the order of
elimination follows from the nodes' places: branches and elements are halved by place until few are left, and of two
halves together all nodes go that nothing else touches (nested dissection by substructures). For a plain grid
:func:`._ports.port_conductances` does the same with much less bookkeeping.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray
from ._elimination import ULP, Rounded, eliminate_leading
from ._ports import IDEAL_WIRE, LARGEST_PART

_LEAF = 48  # branches that are assembled and eliminated at once


class Element(NamedTuple):
    """A part with more than two ends, itself reduced to them."""

    nodes: IntArray
    between: FloatArray
    """(..., nodes, nodes) S"""
    relative: float = 0.0
    """bound on the relative error of ``between``"""


@dataclass(frozen=True)
class Network:
    """Nodes, the branches between them, and elements."""

    place: FloatArray
    """(nodes, axes): where each node is; only the order of elimination depends on it"""
    ends: IntArray
    """(branches, 2) nodes"""
    conductance: FloatArray
    """(..., branches) S; inf is a short, and 0 nothing"""
    wire: BoolArray
    """(branches,): of infinite conductances, those that hold their potential even against a short"""
    ports: IntArray
    """(ports,) nodes"""
    elements: tuple[Element, ...] = ()


class _Part(NamedTuple):
    """What is left of some branches and elements: nodes, and the network between them."""

    nodes: IntArray
    touched: IntArray
    """how many of each node's branches and elements are in"""
    between: FloatArray
    relative: FloatArray
    """(...,) bound on the relative error of ``between``"""


def reduce(network: Network) -> Rounded:
    """Port conductances (..., ports, ports) in S, zero on the diagonal, and their relative error (...,)."""
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
        among = items[items >= branches] - branches
        if len(items) == 1 or (len(items) <= _LEAF and len(among) <= 1):
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
    """With each infinite conductance replaced by a large one: a short outdoes every part, a wire every short."""
    largest = max(
        float(np.max(values, where=np.isfinite(values), initial=LARGEST_PART))
        for values in (network.conductance, *(element.between for element in network.elements))
    )
    short = IDEAL_WIRE * largest
    conductance = np.minimum(network.conductance, np.where(network.wire, IDEAL_WIRE * short, short))
    return conductance, [part._replace(between=np.minimum(part.between, short)) for part in network.elements]
