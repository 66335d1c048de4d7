"""Programs as JAX traces them: to see that nothing in one grows faster than the system does, and how its loops end."""


def equations_of(closed):
    """All equations of a program, those of the programs it calls included."""
    programs = [closed.jaxpr]
    while programs:
        for equation in programs.pop().eqns:
            yield equation
            inner = [part for value in equation.params.values() for part in (value if isinstance(value, (tuple, list)) else [value])]
            programs += [getattr(part, "jaxpr", part) for part in inner if hasattr(getattr(part, "jaxpr", part), "eqns")]


def largest_array_and_count(closed):
    """The most numbers of an array, and how many equations there are."""
    sizes, count = [], 0
    for equation in equations_of(closed):
        count += 1
        sizes += [getattr(v.aval, "size", 0) for v in equation.outvars]
    return max(sizes), count
