"""How a motion is kept on its constraints."""

from ._mechanics.projection import Baumgarte as Baumgarte, NoStabilisation as NoStabilisation, Projection as Projection
