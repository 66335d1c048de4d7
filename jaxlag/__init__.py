"""Differentiable mechanics: from energies, dissipation functions and constraints to motions and identified machines."""

from importlib import metadata as _metadata

from . import (
    direction as direction,
    dissipation as dissipation,
    elements as elements,
    interpolation as interpolation,
    learnt as learnt,
    plot as plot,
    results as results,
    rigid as rigid,
    stabilisation as stabilisation,
    surfaces as surfaces,
)
from ._mechanics.acceleration import acceleration as acceleration, constraint_force as constraint_force
from ._paper.equations import equations as equations
from ._paper.fmu import to_fmu as to_fmu
from ._paper.to_sympy import to_sympy as to_sympy
from ._mechanics.examine import examine as examine
from ._mechanics.friction_treatment import Regularised as Regularised, StickSlip as StickSlip
from ._curves.equilibrium_curve import equilibrium_curve as equilibrium_curve
from ._curves.response_curve import response_curve as response_curve
from ._fit.information import information as information
from ._fit.validate import validate as validate
from ._fit.comparison import compare as compare
from ._fit.experiment import Experiment as Experiment
from ._fit.frequency_response_test import FrequencyResponseTest as FrequencyResponseTest
from ._fit.fit import fit as fit
from ._fit.fit import fit_each as fit_each
from ._fit.robust_loss import Huber as Huber
from ._fit.starts import MultiStart as MultiStart, Regress as Regress
from ._fit.measurement import Measurement as Measurement
from ._fit.modal_test import ModalTest as ModalTest
from ._fit.log_density import log_density as log_density
from ._fit.recover import recover as recover
from ._fit.discover import discover as discover
from ._fit.design import design as design
from ._fit.design_criteria import AOptimal as AOptimal, Along as Along, Average as Average
from ._fit.design_criteria import DOptimal as DOptimal, EOptimal as EOptimal, Worst as Worst
from ._fit.regress import regress as regress
from ._fit.response_curve_test import ResponseCurveTest as ResponseCurveTest
from ._motion.simulate import simulate as simulate
from ._motion.load import load as load
from ._motion.simulate_many import simulate_many as simulate_many
from ._motion.stepper import stepper as stepper
from ._linear.equilibrium import equilibrium as equilibrium, steady as steady
from ._linear.linearise import linearise as linearise
from ._linear.root_locus import root_locus as root_locus
from ._linear.lowest_modes import lowest_modes as lowest_modes
from ._linear.periodic import periodic as periodic
from ._optimal.optimise_motion import optimise_motion as optimise_motion
from ._linear.stability_map import stability_map as stability_map
from ._program.compilation_cache import keep_compiled as keep_compiled
from ._model.contact import Contact as Contact, NewtonRestitution as NewtonRestitution, PoissonRestitution as PoissonRestitution
from ._model.excitation import Chirp as Chirp, Multisine as Multisine
from ._model.event import Event as Event, Every as Every
from ._model.kinematics import rate as rate, substitute as substitute, virtual_work as virtual_work
from ._mechanics.consistent_state import consistent_state as consistent_state
from ._mechanics.lagrange import (
    constraint_jacobian as constraint_jacobian,
    constraint_residual as constraint_residual,
    energy as energy,
    mass_matrix as mass_matrix,
    momentum as momentum,
)
from ._mechanics.power import powers as powers
from ._motion.runge_kutta import Dop853 as Dop853, Dopri5 as Dopri5
from ._model.signal import Signal as Signal
from ._model.states import Sampled as Sampled, State as State
from ._model.system import System as System

try:
    __version__ = _metadata.version("jaxlag")
except _metadata.PackageNotFoundError:  # a source tree that is not installed
    __version__ = "0+unknown"
