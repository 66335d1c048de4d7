"""Differentiable mechanics: from energies, dissipation functions and constraints to motions and identified machines."""

from . import dissipation as dissipation, learnt as learnt, plot as plot
from ._acceleration import Acceleration as Acceleration, acceleration as acceleration, constraint_force as constraint_force
from ._animate import animate as animate
from ._equations import Equations as Equations, equations as equations, to_sympy as to_sympy
from ._examine import Examination as Examination, examine as examine
from ._friction import Regularised as Regularised, StickSlip as StickSlip
from ._assess import (
    Comparison as Comparison,
    Information as Information,
    Validation as Validation,
    compare as compare,
    information as information,
    validate as validate,
)
from ._experiment import Experiment as Experiment
from ._fit import Fit as Fit, Interval as Interval, Prediction as Prediction
from ._identify import fit as fit, fit_each as fit_each
from ._prediction import Huber as Huber
from ._quality import Channel as Channel
from ._regress import Regression as Regression, regress as regress
from ._integrate import simulate as simulate
from ._load import load as load
from ._many import simulate_many as simulate_many
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
from ._runge_kutta import Dop853 as Dop853, Dopri5 as Dopri5
from ._results import RESULTS as RESULTS
from ._signal import Signal as Signal
from ._system import System as System
from ._trajectory import (
    Instant as Instant,
    Interpolated as Interpolated,
    Rubbing as Rubbing,
    Trajectory as Trajectory,
)
