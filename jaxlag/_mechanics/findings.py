"""What `examine` says of a system, sentence by sentence, each with its cure."""

import jax.numpy as jnp
import numpy as np

from .couplings import NOT_READ, OF_L, OF_ROWS
from .self_consistent import NOT_CONSISTENT
from .singular_directions import faint_direction, massless_coordinates

FAINT = 5e-4  # of the inertia of each coordinate alone: Euler angles of a ball 2° from their singularity


def pulling(system, multipliers):
    """One-sided constraints that would have to pull."""
    for name in system.one_sided:
        least, size = np.min(multipliers[name], initial=0.0), np.max(np.abs(multipliers[name]), initial=0.0)
        if least < -np.sqrt(np.finfo(multipliers[name].dtype).eps) * size:
            yield (
                f"the one-sided constraint {name!r} would have to pull here (λ = {least:.3g}), so its contact would open: "
                "the motion enforces it all the same, as an equality"
            )


def not_unique(multipliers, others):
    """Multipliers of which there is none that agrees with the forces they bring about, or more than one."""
    if any(np.any(np.isnan(of)) for of in multipliers.values()):
        yield NOT_CONSISTENT
        return
    numbers = lambda of: " ".join(f"{number:.4g}" for number in np.ravel(of))
    shown = lambda named: ", ".join(f"{name!r} {numbers(of)}" for name, of in named.items())
    for row in range(min((len(of) for of in others.values()), default=0)):
        other = {name: of[row] for name, of in others.items()}
        if all(np.all(np.isfinite(of)) for of in other.values()):
            yield (
                f"more than one set of multipliers agrees with the forces that depend on them: {shown(multipliers)}, which the motion "
                f"takes, since the forces lead there from none, and {shown(other)}: write forces for which there is one only"
            )
            return


def without_inertia(names, M, G, units):
    """A direction that has no inertia, and that nothing holds."""
    free = [names[i] for i in massless_coordinates(M, G, units)]
    if free:
        yield (
            f"a direction that no constraint holds has no inertia: {', '.join(map(repr, free))}; add the missing mass (a small one with "
            "`solver=diffrax.Kvaerno5()`), a constraint that holds it, or a D of its velocity, or leave the coordinate out"
        )


def nearly_without_inertia(names, M, G):
    """Such as two Euler angles near their singularity, where they turn about the same axis."""
    least, moving = faint_direction(M, G)
    if 1e-12 < least < FAINT:
        listed = ", ".join(repr(names[i]) for i in moving)
        yield (
            f"together {listed} have in one direction only {least:.2g} of the inertia that each has alone: where they are angles near "
            "their singularity (`margin` of `rigid.euler`), steps become small; take another sequence, or a quaternion"
        )


def not_affine(names, where):
    """Velocity constraints that are not affine in a velocity."""
    listed = ", ".join(repr(names[i]) for i in np.flatnonzero(where))
    if listed:
        yield f"a nonholonomic constraint is not affine in the velocity of {listed}: write its derivative, or a root of it"


def pushing(names, M, G, rows, units, system):
    """Velocity constraints that tie a coordinate without inertia to others: their λ acts on these too, unlike a first-order law."""
    size = np.max(np.abs(M * np.outer(units, units)), axis=1)
    massless = size <= 100 * len(M) * np.finfo(M.dtype).eps * np.max(size, initial=0.0)
    for name in (name for name, _ in system.nonholonomic):
        for row in G[rows[name]] * units:
            part = np.abs(row) > 1e-12 * np.max(np.abs(row), initial=0.0)
            driven, pushed = ([names[i] for i in np.flatnonzero(part & of)] for of in (massless, ~massless))
            if driven and pushed:
                yield (
                    f"constraint {name!r} ties {', '.join(map(repr, driven))}, without inertia, to {', '.join(map(repr, pushed))}, and its "
                    "λ pushes these too: right for a rod or a gear, wrong for a law such as that of a spring and damper in series, "
                    "which must push by a force or an energy alone"
                )


def of_numbers(numbers, distances, defect, dtype):
    """Numbers that are not what they should be: defects, redundant rows, a state off its constraints, energy that is added, stiffness."""
    if defect > float(jnp.finfo(dtype).eps) ** 0.5:
        yield (
            f"the accelerations miss Lagrange's equations, as JAX alone differentiates them, by {defect:.2g} of the largest term: "
            "do not trust them, and report the functions of this system as an error of jaxlag"
        )
    if numbers["degrees_of_freedom"] == 0:
        names = ", ".join(map(repr, numbers["dissipated"]))
        beside = f"; of dissipation {names} only λ tells, and dry friction carries nothing at rest" if names else ""
        yield f"no degree of freedom is left: the constraints hold every coordinate{beside}"
    for name, count in numbers["redundant"].items():
        yield (
            f"of constraint {name!r} {count} of the rows follow from those before: the motion is unique, λ is the one of least norm; "
            "leave these rows out where each reaction matters"
        )
    for what in ("position", "velocity"):
        for name, value in numbers[f"off_{what}"].items():
            if distances[what][name] > float(jnp.finfo(dtype).eps) ** 0.5:
                yield f"the {what} is off constraint {name!r} by {value:.2g}: `consistent_state` corrects it, `simulate` does so by itself"
    for name, least in numbers["dissipated"].items():
        if least < 0:
            yield (
                f"dissipation {name!r} adds energy near this state (q̇·∂D/∂q̇ = {least:.2g}): "
                "right for wind or a moving belt, otherwise check its sign"
            )
    fastest, slowest = numbers["time_constants"]
    if np.isfinite(slowest) and slowest > 1e4 * fastest:
        yield f"the motion is stiff (time constants from {fastest:.2g} to {slowest:.2g}): use `solver=diffrax.Kvaerno5()`"
    if jnp.finfo(dtype).bits < 64:
        yield 'single precision: `jax.config.update("jax_enable_x64", True)` gives twice as many digits'


def bending(surfaces, has_events):
    """Functions that choose where steps do not end, each line once."""
    for line in dict.fromkeys(surface.line for surface in surfaces):
        here = [surface for surface in surfaces if surface.line == line]
        functions = list(dict.fromkeys(surface.function for surface in here))
        chosen = ", ".join(dict.fromkeys(f"`{surface.what}`" for surface in here))
        beside = ", unless one of `events` is zero there" if has_events else ""
        yield (
            f"{' and '.join(functions)} {'chooses' if len(functions) == 1 else 'choose'} ({chosen}, {line}): "
            "where the choice changes, a force jumps or bends, and the steps of "
            "a motion do not end there, so that it errs by more than its tolerance, and derivatives by what decides are wrong where a "
            f'force jumps{beside}: end them by `events={{"edge": jl.Event(lambda q: ...)}}`, a function that is zero there'
        )


def coupling_all(couplings, uses_all_numbers, n):
    """Terms that leave no zeros to a solve for many coordinates."""
    for (matrix, name), (entries, size, is_full) in couplings.items():
        if not is_full or (matrix == OF_L and not uses_all_numbers):
            continue
        counted = "its program is too long to be read" if entries == NOT_READ else f"{entries} of {size} numbers"
        each = "an acceleration takes" if matrix in (OF_L, OF_ROWS) else "implicit solvers and `linearise` take"
        cure = (
            "let each of its rows touch a few coordinates, as of rods between neighbours"
            if matrix == OF_ROWS
            else "write it as a sum of terms that touch a few coordinates each: positions, with rods as `holonomic` constraints, in place "
            "of joint angles of which positions are cumulative sums"
        )
        yield f"{name!r} couples the {n} coordinates ({matrix}: {counted}), so that {each} time in proportion to n³: {cure}"
