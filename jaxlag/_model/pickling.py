"""Functions in pickles: stored by the name under which Python finds them again, with clear errors on both sides."""

import dataclasses
import importlib
import operator
import pickle
import sys
from collections.abc import Callable
from typing import Any

INSTEAD = (
    "To keep results without any functions, save them with `motion.save(file)` or `fit.save(file)` and load them with `jl.load(file)`."
)


@dataclasses.dataclass(frozen=True)
class Reference:
    """Where a function can be imported from."""

    module: str
    name: str

    def found(self) -> Any:
        """The function; raises AttributeError or ImportError where it does not exist."""
        return operator.attrgetter(self.name)(importlib.import_module(self.module))


def picklable(function: Callable, label: str) -> Any:
    """What represents a function in a pickle.

    Where cloudpickle or dill is loaded, which pickle functions by value, the function itself.
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
        f"{label} must be a function of a module to be pickled, but {name or type(function).__name__!r} cannot be found by its name. "
        f"Define it with `def` in a module. {INSTEAD}"
    )


def unpickled(reference: Any) -> Callable:
    """The function that something in a pickle represents."""
    if not isinstance(reference, Reference):
        return reference
    try:
        return reference.found()
    except (AttributeError, ImportError) as error:
        raise pickle.UnpicklingError(
            f"the functions of a system must be importable as when it was pickled, but there is no {reference.name!r} in module "
            f"{reference.module!r}. Define it there first. {INSTEAD}"
        ) from error
