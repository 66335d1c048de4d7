"""The course of a `Signal` between its samples."""

from ._model.signal_interpolation import Cubic as Cubic, Linear as Linear, ZeroOrderHold as ZeroOrderHold
