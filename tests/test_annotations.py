"""Public functions and methods say the types of all their parameters and of what they return, so that mypy checks them."""

import inspect

import pytest

import jaxlag
from jaxlag import dissipation, learnt, plot, rigid

pytestmark = pytest.mark.fast

MODULES = {"": jaxlag, "dissipation.": dissipation, "learnt.": learnt, "plot.": plot, "rigid.": rigid, "rigid.inertia.": rigid.inertia}


def public_functions():
    """Functions, constructors, methods and properties of the package, by name."""
    for prefix, module in MODULES.items():
        for name, thing in vars(module).items():
            if name.startswith("_") or not callable(thing) or not thing.__module__.startswith("jaxlag"):
                continue
            members = {f".{member}": value for member, value in vars(thing).items()} if inspect.isclass(thing) else {"": thing}
            for member, value in members.items():
                function = inspect.unwrap(getattr(value, "fget", None) or getattr(value, "__func__", value))
                is_public = not member.startswith("._") or member in (".__init__", ".__call__")
                if is_public and inspect.isfunction(function) and function.__module__.startswith("jaxlag"):
                    if member == ".__init__" and function.__qualname__ != f"{thing.__name__}.__init__":
                        continue  # generated
                    yield f"{prefix}{name}{member}", function


def test_they_are_annotated():
    for name, function in public_functions():
        signature = inspect.signature(function)
        parameters = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
        assert not [p.name for p in parameters if p.annotation is p.empty], name
        assert signature.return_annotation is not inspect.Signature.empty or name.endswith("__init__"), name
