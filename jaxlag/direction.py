"""The direction in which the function of an `Event` has to pass through zero."""

from ._model.event import Either as Either, Falling as Falling, Negative as Negative, Rising as Rising
