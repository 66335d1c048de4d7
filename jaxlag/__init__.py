"""Differentiable mechanics: from energies, dissipation functions and constraints to motions and identified machines."""

from . import dissipation as dissipation
from ._acceleration import Acceleration as Acceleration, acceleration as acceleration, constraint_force as constraint_force
from ._equations import Equations as Equations, equations as equations, to_sympy as to_sympy
from ._examine import Examination as Examination, examine as examine
from ._friction import Regularised as Regularised, StickSlip as StickSlip
from ._identify import Experiment as Experiment, Fit as Fit, fit as fit
from ._integrate import simulate as simulate
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
from ._power import powers as powers
from ._results import RESULTS as RESULTS
from ._system import System as System
from ._trajectory import Rubbing as Rubbing, Trajectory as Trajectory
