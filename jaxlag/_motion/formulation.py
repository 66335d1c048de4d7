"""How the equations of motion are formulated."""

from typing import NamedTuple

from .._mechanics.friction_treatment import Regularised, StickSlip
from .._mechanics.projection import Baumgarte, NoStabilisation, Projection
from .._mechanics.surfaces import Located, NotLocated

PROJECTION = "projection"  # name of the work that projection does


class Formulation(NamedTuple):
    """How the equations of motion are formulated: treatment of the constraints, of dry friction, and of surfaces across which functions of
    the system jump or bend; whether works are tracked.
    """

    stabilisation: Projection | Baumgarte | NoStabilisation = Projection()
    friction: StickSlip | Regularised = StickSlip()
    surfaces: Located | NotLocated = Located()
    works: bool = False
