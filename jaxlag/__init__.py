"""Differentiable mechanics: from energies, dissipation functions and constraints to motions and identified machines."""

from importlib.metadata import PackageNotFoundError, version

from . import dissipation as dissipation, learnt as learnt, plot as plot, rigid as rigid
from ._mechanics.acceleration import Acceleration as Acceleration, acceleration as acceleration, constraint_force as constraint_force
from ._draw.animate import animate as animate
from ._paper.equations import equations as equations
from ._paper.linearised_result import LinearisedEquations as LinearisedEquations
from ._paper.result import Equations as Equations
from ._paper.to_sympy import to_sympy as to_sympy
from ._mechanics.examine import Examination as Examination, examine as examine
from ._mechanics.friction_treatment import Regularised as Regularised, StickSlip as StickSlip
from ._fit.assess import (
    Comparison as Comparison,
    Information as Information,
    Validation as Validation,
    compare as compare,
    information as information,
    validate as validate,
)
from ._fit.experiment import Experiment as Experiment
from ._fit.frequency_response_test import FrequencyResponseTest as FrequencyResponseTest
from ._fit.result import Fit as Fit, Interval as Interval, Prediction as Prediction
from ._fit.fit import fit as fit, fit_each as fit_each
from ._fit.robust_loss import Huber as Huber
from ._fit.channels import Channel as Channel
from ._fit.lead_in import Regress as Regress
from ._fit.modal_test import ModalTest as ModalTest
from ._fit.regress import Regression as Regression, regress as regress
from ._motion.simulate import simulate as simulate
from ._motion.load import load as load
from ._motion.simulate_many import simulate_many as simulate_many
from ._linear.equilibrium import Equilibrium as Equilibrium, equilibrium as equilibrium, steady as steady
from ._linear.linear_system import LinearSystem as LinearSystem
from ._linear.linearise import linearise as linearise
from ._linear.root_locus import Crossing as Crossing, RootLocus as RootLocus, root_locus as root_locus
from ._linear.lowest_modes import lowest_modes as lowest_modes
from ._linear.modes import Modes as Modes
from ._linear.periodic import PeriodicOrbit as PeriodicOrbit, periodic as periodic
from ._linear.stability_map import StabilityMap as StabilityMap, stability_map as stability_map
from ._program.compilation_cache import keep_compiled as keep_compiled
from ._model.contact import Contact as Contact, Newton as Newton, Poisson as Poisson
from ._model.event import (
    Either as Either,
    Event as Event,
    Every as Every,
    Falling as Falling,
    Negative as Negative,
    Rising as Rising,
)
from ._model.kinematics import rate as rate, substitute as substitute, virtual_work as virtual_work
from ._mechanics.projection import (
    Baumgarte as Baumgarte,
    NoStabilisation as NoStabilisation,
    Projection as Projection,
)
from ._mechanics.consistent_state import consistent_state as consistent_state
from ._mechanics.lagrange import (
    Residual as Residual,
    constraint_jacobian as constraint_jacobian,
    constraint_residual as constraint_residual,
    energy as energy,
    mass_matrix as mass_matrix,
    momentum as momentum,
)
from ._mechanics.power import powers as powers
from ._motion.runge_kutta import Dop853 as Dop853, Dopri5 as Dopri5
from ._motion.results import RESULTS as RESULTS
from ._model.signal import Signal as Signal
from ._model.signal_interpolation import Cubic as Cubic, Linear as Linear, ZeroOrderHold as ZeroOrderHold
from ._model.states import Sampled as Sampled, State as State
from ._model.system import System as System
from ._motion.moments import ContactState as ContactState, EventState as EventState
from ._motion.trajectory import (
    Instant as Instant,
    Interpolated as Interpolated,
    FrictionState as FrictionState,
    Trajectory as Trajectory,
)

try:
    __version__ = version("jaxlag")
except PackageNotFoundError:  # a source tree that is not installed
    __version__ = "0+unknown"


def __getattr__(name: str) -> object:
    """Names of the version before."""
    if name == "Rubbing":
        from ._model.deprecation import warn_renamed

        warn_renamed("Rubbing", "FrictionState")
        return FrictionState
    raise AttributeError(f"module 'jaxlag' has no attribute {name!r}")
