"""Readout circuits (transimpedance amplifiers, dividers, followers): one object each, all in :data:`CIRCUITS`.

=================================  =====================================================================
:mod:`._circuit`                   the base class: interface of a circuit to the rest of the package
:mod:`._inverting_amplifier`       transimpedance amplifiers on the columns (the paper's figure 15)
:mod:`._row_amplifier`             the same with rows sensed and columns driven
:mod:`._voltage_divider`           load resistors (the paper's figure 13)
:mod:`._described`                 networks that the design describes part by part
:mod:`._voltage_feedback`          a load, and a follower that drives all idle lines
:mod:`._port_law`                  what a reading says of its own conductance and of its column, for :mod:`..recovery`
:mod:`._terminated`                columns that end in Thevenin equivalents, at once or in turns
:mod:`._ends`                      their currents
:mod:`._nodal`                     ends that are no Thevenin equivalents
:mod:`._linear`                    outputs as a linear function of transfer conductances
:mod:`._adjoint`                   forward and adjoint port potentials, for the derivatives of readings
:mod:`._quick`                     outputs and their fields by plain nodal analysis, without bounds
:mod:`._rounding`                  bound on the rounding errors of outputs
=================================  =====================================================================
"""

from ._adjoint import SensitivityGroup
from ._circuit import Reading, ReadoutCircuit
from ._described import networks
from ._ends import one_driven, terminate
from ._inverting_amplifier import InvertingAmplifier
from ._linear import LinearReadout, output_rounding
from ._port_law import PortLaw
from ._quick import PortFields, QuickFields, QuickNetwork, columns_impedance
from ._row_amplifier import RowAmplifier
from ._voltage_divider import VoltageDivider
from ._voltage_feedback import VoltageFeedback

CIRCUITS: dict[str, ReadoutCircuit] = {
    circuit.name: circuit for circuit in (InvertingAmplifier(), VoltageDivider(), VoltageFeedback(), RowAmplifier())
}
"""By the name that a design file gives as ``readout.circuit``"""

__all__ = [
    "CIRCUITS",
    "LinearReadout",
    "PortFields",
    "PortLaw",
    "QuickFields",
    "QuickNetwork",
    "Reading",
    "ReadoutCircuit",
    "SensitivityGroup",
    "columns_impedance",
    "networks",
    "one_driven",
    "output_rounding",
    "terminate",
]
