"""How large a program is: to see that nothing in it grows faster than the system does."""


def largest_array_and_count(closed):
    """The most numbers of an array, and how many equations there are, those of the programs it calls included."""
    sizes, count, programs = [], 0, [closed.jaxpr]
    while programs:
        for equation in programs.pop().eqns:
            count += 1
            sizes += [getattr(v.aval, "size", 0) for v in equation.outvars]
            inner = [part for value in equation.params.values() for part in (value if isinstance(value, (tuple, list)) else [value])]
            programs += [getattr(part, "jaxpr", part) for part in inner if hasattr(getattr(part, "jaxpr", part), "eqns")]
    return max(sizes), count
