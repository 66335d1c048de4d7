"""The classes that functions of jaxlag return, for annotations and `isinstance`; you need not create any of them."""

from ._curves.equilibrium_curve import EquilibriumCurve as EquilibriumCurve
from ._curves.equilibrium_curve import SpecialEquilibrium as SpecialEquilibrium
from ._curves.measures import Measured as Measured
from ._curves.response_curve import ResponseCurve as ResponseCurve, SpecialPoint as SpecialPoint
from ._fit.information import Information as Information
from ._fit.validate import Validation as Validation
from ._fit.comparison import Comparison as Comparison
from ._fit.channels import Channel as Channel
from ._fit.design import Design as Design
from ._fit.discover import Discovery as Discovery
from ._fit.log_density import LogDensity as LogDensity
from ._fit.posterior import Posterior as Posterior
from ._fit.recover import Recovery as Recovery
from ._fit.regress import Regression as Regression
from ._fit.result import Fit as Fit, Interval as Interval, Prediction as Prediction
from ._linear.equilibrium import Equilibrium as Equilibrium
from ._linear.linear_system import LinearSystem as LinearSystem
from ._linear.modes import Modes as Modes
from ._linear.periodic import PeriodicOrbit as PeriodicOrbit
from ._linear.root_locus import Crossing as Crossing, RootLocus as RootLocus
from ._linear.stability_map import StabilityMap as StabilityMap
from ._mechanics.acceleration import Acceleration as Acceleration
from ._mechanics.examine import Examination as Examination
from ._mechanics.surfaces import Surface as Surface
from ._mechanics.lagrange import Residual as Residual
from ._motion.moments import ContactState as ContactState, EventState as EventState
from ._motion.results import RESULTS as RESULTS
from ._motion.stepper import Stepper as Stepper, StepState as StepState
from ._motion.trajectory import (
    FrictionState as FrictionState,
    Instant as Instant,
    Interpolated as Interpolated,
    Trajectory as Trajectory,
)
from ._optimal.solution import OptimalMotion as OptimalMotion
from ._paper.linearised_result import LinearisedEquations as LinearisedEquations
from ._paper.result import Equations as Equations
