"""Motions and fits from files."""

import dataclasses
import json
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._mechanics.friction_treatment import Regularised, StickSlip
from .export import FORMAT, filled_outline
from .moments import ContactState, EventState, FrictionState
from .provenance import Recorded
from .results import result_of
from .trajectory import Trajectory


def load(file: str | Path) -> Any:
    """A motion or a fit from a file written by `Trajectory.save` or `Fit.save`. None of the user's functions are needed.

    **Arguments:** `file`: the path that was given to `save`.

    **Returns:** for a motion, a `Trajectory` with all its samples, result, stats, energies, slip velocities, and the numbers of its
    params; what needs the system itself, such as forces on points in `animate`, raises an error that says so. Mappings and sequences
    become dicts and lists; a NamedTuple or another object becomes the dict of its fields. For a fit, the dict of `Fit.to_dict`, with its
    card under `"card"`.

    **Raises:** `ValueError` if the file is neither; whatever `open` raises.

    **Source:** NumPy's format NPY 1.0 (NEP 1) in a ZIP archive, without pickled objects; JSON, RFC 8259.

    ```python
    import pathlib, tempfile
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    motion = jl.simulate(oscillator, 1.0, 0.0, jnp.linspace(0, 10, 11), {"c": 4.0})
    file = pathlib.Path(tempfile.mkdtemp()) / "motion.npz"
    motion.save(file)
    jl.load(file).q[-1]  # cos(2 · 10) = 0.408
    ```
    """
    try:
        about, arrays = _read(Path(file))
        version = about.pop("format")
        if about.pop("jaxlag") != ("Trajectory" if arrays else "Fit"):
            raise KeyError
    except (KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"`file` must be written by `save` of a motion or a fit, but {str(file)!r} is not. Look at its name.") from error
    if version > FORMAT:
        raise ValueError(f"`file` must be of format {FORMAT} or before, but is of format {version}. Load it with a newer jaxlag.")
    return _motion(about, arrays) if arrays else about


def _read(file):
    """The description in a file, and its arrays."""
    with open(file, "rb") as stream:
        is_archive = stream.read(2) == b"PK"
    if not is_archive:
        return json.loads(file.read_text(encoding="utf-8")), {}
    with np.load(file, allow_pickle=False) as archive:
        arrays = dict(archive)
    return json.loads(str(arrays.pop("about"))), arrays


def _motion(about, arrays):
    def part(prefix):
        """The arrays of one kind, by their names within it."""
        return {name.removeprefix(f"{prefix}."): jnp.asarray(x) for name, x in arrays.items() if name.startswith(f"{prefix}.")}

    tree = lambda name: jax.tree.map(jnp.asarray, filled_outline(about["outlines"][name], arrays))
    like = about["outlines"]["q"]
    rate = lambda name: jax.tree.map(lambda leaf: jnp.asarray(arrays[name + leaf.removeprefix("q")]), like)
    kinds = {kind.__name__: kind for kind in (StickSlip, Regularised)}
    (friction,) = (kinds[name](**fields) for name, fields in about["friction"].items())
    energy, friction_states, of_contacts = part("energy"), part("friction"), part("contacts")
    terms, contacts = (list(dict.fromkeys(name.rpartition(".")[0] for name in of)) for of in (friction_states, of_contacts))
    happened = tree("happened") if "happened" in about["outlines"] else {}
    events = {name: EventState(**record, count=jnp.asarray(arrays[f"events.{name}.count"])) for name, record in happened.items()}
    fields = [field.name for field in dataclasses.fields(ContactState)]
    return Trajectory(
        ts=jnp.asarray(arrays["t"]),
        q=tree("q"),
        qdot=rate("qdot"),
        qddot=rate("qddot"),
        multipliers=tree("multipliers"),
        states=tree("states") if "states" in about["outlines"] else {},
        result=result_of(arrays["result"]),
        stats=part("stats"),
        works=part("works") if about["audit"] else None,
        friction={term: FrictionState(friction_states[f"{term}.force"], friction_states[f"{term}.sticking"]) for term in terms},
        contacts={name: ContactState(*(of_contacts[f"{name}.{field}"] for field in fields)) for name in contacts},
        events=events,
        provenance=Recorded(
            (energy["h"], energy["turned"]),
            part("slip"),
            tree("params"),
            tuple(about["one_sided"]),
            friction,
            tuple(map(tuple, about.get("units", ()))),
        ),
    )
