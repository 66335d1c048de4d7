"""How the equations of motion are formulated."""

from typing import NamedTuple

from .._mechanics.friction_treatment import Regularised, StickSlip
from .._mechanics.projection import Baumgarte, NoStabilisation, Projection

PROJECTION = "projection"  # name of the work that projection does


class Formulation(NamedTuple):
    """How the equations of motion are formulated: treatment of the constraints, treatment of dry friction, whether works are tracked."""

    stabilisation: Projection | Baumgarte | NoStabilisation = Projection()
    friction: StickSlip | Regularised = StickSlip()
    works: bool = False
