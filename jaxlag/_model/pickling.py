"""Functions in pickles: by the name under which Python finds them again; what has none is told so, on both sides."""

import dataclasses
import importlib
import operator
import pickle
import sys
from collections.abc import Callable
from typing import Any

INSTEAD = (
    "Results need none of the functions where they are saved by `motion.save(file)` or `fit.save(file)` and loaded by `jl.load(file)`."
)


@dataclasses.dataclass(frozen=True)
class Reference:
    """Where a function is found."""

    module: str
    name: str

    def found(self) -> Any:
        """The function; AttributeError or ImportError where it is not there."""
        return operator.attrgetter(self.name)(importlib.import_module(self.module))


def portable(function: Callable, spoken: str) -> Any:
    """What stands for a function in a pickle.

    Picklers that take functions along as they are, where there are any in this process, are not stood in the way of.
    """
    if any(module.rpartition(".")[2] in ("cloudpickle", "dill") for module in sys.modules):
        return function
    name = getattr(function, "__qualname__", None)
    try:
        if name is not None and (reference := Reference(function.__module__, name)).found() is function:
            return reference
    except (AttributeError, ImportError):
        pass
    try:
        pickle.dumps(function)
        return function
    except (pickle.PicklingError, AttributeError, TypeError):
        pass
    raise pickle.PicklingError(
        f"{spoken} must be a function of a module for a pickle, but {name or type(function).__name__!r} is not to be found by its name. "
        f"Define it by `def` in a module. {INSTEAD}"
    )


def restored(stands: Any) -> Callable:
    """The function that something in a pickle stands for."""
    if not isinstance(stands, Reference):
        return stands
    try:
        return stands.found()
    except (AttributeError, ImportError) as error:
        raise pickle.UnpicklingError(
            f"the functions of a system must be where they were when it was pickled, but there is no {stands.name!r} in module "
            f"{stands.module!r}. Import or define it there first. {INSTEAD}"
        ) from error
