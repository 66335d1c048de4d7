"""Learnt potentials: a dissipation function D(q̇) or a potential V(q) that is a neural network, physically sound whatever its weights.

A network is an `equinox.Module` of arrays, so it is an entry of params: differentiated, batched and fitted like any other parameter.

    system = jl.System(lagrangian, dissipation=lambda qdot, net: net(qdot))
    params = {"m": 2.0, "net": jl.learnt.PassiveDissipation(0.1, power=0.5, key=jax.random.key(0))}

The properties of a dissipation function are built in, not left to the data:

    ConvexDissipation     D convex, D(0) = 0, ∂D(0) = 0   so  q̇ · ∂D/∂q̇ ≥ D ≥ 0
    PassiveDissipation    D grows on every ray from rest  so  q̇ · ∂D/∂q̇ ≥ 0, and D ≥ 0; the force may fall with the speed
    Potential             V any smooth bounded function
    ConvexPotential       V convex, with its minimum 0 at a given position
"""

from ._dissipation import ConvexDissipation as ConvexDissipation
from ._dissipation import PassiveDissipation as PassiveDissipation
from ._potential import ConvexPotential as ConvexPotential
from ._potential import Potential as Potential
