"""Any resistor network reduced to its ports: what a plain grid is not (bridged lines, the continuous sheet).

The same positive arithmetic as :mod:`.ports`, so the same accuracy whatever the resistances span, but the order of
elimination follows from the nodes' places: the branches are halved by place until few are left, and of two halves
together all nodes go that no other branch touches (nested dissection by substructures). For a plain grid
:func:`.ports.port_conductances` does the same with much less bookkeeping.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .ports import IDEAL_WIRE, LARGEST_PART, eliminate_leading

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

_LEAF = 48  # branches that are assembled and eliminated at once


@dataclass(frozen=True)
class Network:
    """Nodes and the branches between them."""

    place: FloatArray
    """(nodes, axes): where each node is; only the order of elimination depends on it"""
    ends: IntArray
    """(branches, 2) nodes"""
    conductance: FloatArray
    """(..., branches) S; inf is a short, and 0 nothing"""
    wire: NDArray[np.bool_]
    """(branches,): of infinite conductances, those that hold their potential even against a short"""
    ports: IntArray
    """(ports,) nodes"""


class _Part(NamedTuple):
    """What is left of a set of branches: some nodes, and the network between them."""

    nodes: IntArray
    touched: IntArray
    """how many of each node's branches are in"""
    between: FloatArray


def reduce(network: Network) -> FloatArray:
    """Port conductances (..., ports, ports) in S, zero on the diagonal."""
    conductance = capped(network)
    degree = np.bincount(network.ends.ravel(), minlength=len(network.place))
    is_port = np.zeros(len(network.place), dtype=np.bool_)
    is_port[network.ports] = True
    middle = network.place[network.ends].mean(axis=1)

    def part(branches: IntArray) -> _Part:
        if len(branches) <= _LEAF:
            nodes, local = np.unique(network.ends[branches], return_inverse=True)
            a, b = local.reshape(-1, 2).T
            touched = np.bincount(local.ravel(), minlength=len(nodes))
            between = np.zeros((*conductance.shape[:-1], len(nodes), len(nodes)))
            for k, branch in enumerate(branches):
                between[..., a[k], b[k]] += conductance[..., branch]
            between += np.swapaxes(between, -1, -2)
        else:
            axis = int(np.argmax(np.ptp(middle[branches], axis=0)))
            order = branches[np.argsort(middle[branches, axis], kind="stable")]
            halves = [part(order[: len(order) // 2]), part(order[len(order) // 2 :])]
            nodes = np.union1d(halves[0].nodes, halves[1].nodes)
            touched = np.zeros(len(nodes), dtype=np.intp)
            between = np.zeros((*conductance.shape[:-1], len(nodes), len(nodes)))
            for half in halves:
                at = np.searchsorted(nodes, half.nodes)
                touched[at] += half.touched
                between[..., at[:, None], at] += half.between
        done = (touched == degree[nodes]) & ~is_port[nodes]
        order = np.argsort(~done, kind="stable")
        gone = int(done.sum())
        kept = order[gone:]
        return _Part(nodes[kept], touched[kept], eliminate_leading(between[..., order[:, None], order], gone))

    whole = part(np.arange(len(network.ends)))
    # Kept nodes stay in ascending order, and so are found.
    at = np.searchsorted(whole.nodes, network.ports)
    return whole.between[..., at[:, None], at]


def capped(network: Network) -> FloatArray:
    """Conductances with each infinite one replaced by a large one: a short outdoes every part, a wire every short."""
    values = network.conductance
    largest = float(np.max(values, where=np.isfinite(values), initial=LARGEST_PART))
    short = IDEAL_WIRE * largest
    return np.minimum(values, np.where(network.wire, IDEAL_WIRE * short, short))
