"""Differentiable mechanics: from energies, dissipation functions and constraints to motions and identified machines."""

from ._examine import Examination as Examination, examine as examine
from ._identify import Experiment as Experiment, Fit as Fit, fit as fit
from ._integrate import RESULTS as RESULTS, Trajectory as Trajectory, simulate as simulate
from ._kinematics import rate as rate, substitute as substitute, virtual_work as virtual_work
from ._manifold import (
    Baumgarte as Baumgarte,
    NoStabilisation as NoStabilisation,
    Projection as Projection,
    consistent_state as consistent_state,
)
from ._mechanics import (
    Residual as Residual,
    constraint_jacobian as constraint_jacobian,
    constraint_residual as constraint_residual,
    energy as energy,
    mass_matrix as mass_matrix,
    momentum as momentum,
)
from ._multipliers import Acceleration as Acceleration, acceleration as acceleration, constraint_force as constraint_force
from ._power import powers as powers
from ._system import System as System
