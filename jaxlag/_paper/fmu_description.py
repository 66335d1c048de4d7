"""The variables of an FMU, and its `modelDescription.xml`."""

from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree as xml

from .._model.paths import is_within
from .fmu_motion import ExportedMotion
from .identifiers import structured

TOLERANCE = 1e-9  # relative, of co-simulation where the experiment gives none


class Variable(NamedTuple):
    """A variable; its value reference is its place."""

    name: str
    description: str
    causality: str
    start: float | None = None
    derivative_of: int | None = None
    unit: str | None = None


def variables(motion: ExportedMotion, inputs: Collection[str], outputs: Collection[str] | None) -> list[Variable]:
    """The variables in the order of their values.

    **Raises:** `ValueError` if `inputs` or `outputs` name nothing, or if two variables have one name.
    """
    n, k, d = len(motion.q), len(motion.states), len(motion.dependent)
    p = 2 * n + k + 1
    z = p + len(motion.params)
    rates = z + n + len(motion.multipliers)
    start = [None, *motion.start[1:]] + [None] * (rates - z + k + 3 * d)
    places = {name: (structured(name), motion.units.get(name.split("[")[0])) for name in (*motion.q, *motion.states, *motion.dependent)}
    q, states, dependent = ([places[name] for name in names] for names in (motion.q, motion.states, motion.dependent))
    time = motion.units.get("t")
    per = lambda unit, time: f"{unit}/{time}" if unit and time else None
    rate = lambda of, i, what: (f"der({of[0]})", f"{what} {of[0]}", i, per(of[1], time))
    second = lambda of, i: (f"der({of[0]},2)", f"acceleration of {of[0]}", i, per(of[1], time and f"{time}^2"))
    found = [
        ("time", "time", None, time),
        *((name, f"coordinate {name}", None, unit) for name, unit in q),
        *(rate(of, 1 + i, "velocity of") for i, of in enumerate(q)),
        *((name, f"state {name}", None, unit) for name, unit in states),
        *((structured(name), f"parameter {name}", None, motion.units.get(name.split("[")[0])) for name in motion.params),
        *(second(of, 1 + n + i) for i, of in enumerate(q)),
        *((structured(f"lambda.{name}"), f"multiplier of constraint {name}", None, None) for name in motion.multipliers),
        *(rate(of, 1 + 2 * n + i, "rate of") for i, of in enumerate(states)),
        *((name, f"coordinate {name}, which follows from others", None, unit) for name, unit in dependent),
        *(rate(of, rates + k + i, "velocity of") for i, of in enumerate(dependent)),
        *(second(of, rates + k + d + i) for i, of in enumerate(dependent)),
    ]
    names = [name for name, *_ in found]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"names must differ in an FMU, but two variables are called {name!r}. Rename a parameter or a coordinate.")
    given = {i: motion.params[i - p] for i in range(p, z)}
    are_inputs = _named("inputs", inputs, given, names, "parameters")
    others = {i: name for i, name in enumerate(names) if i not in given and i}
    are_outputs = set(others) if outputs is None else _named("outputs", outputs, others, names, "coordinates, velocities and others")

    def causality(i):
        if i in given:
            return "input" if i in are_inputs else "parameter"
        return "independent" if i == 0 else "output" if i in are_outputs else "local"

    return [Variable(name, text, causality(i), start[i], *more) for i, (name, text, *more) in enumerate(found)]


def _named(argument: str, asked: Collection[str], there: dict[int, str], names: Sequence[str], what: str) -> set[int]:
    """The variables that are asked for, by name, or by the name of what they are part of."""
    found = set()
    for name in asked:
        mine = {i for i, own in there.items() if is_within(own, name) or is_within(names[i], name)}
        if not mine:
            raise ValueError(
                f"`{argument}` must name {what}, but holds {name!r}. There are {', '.join(names[i] for i in there) or 'none'}."
            )
        found |= mine
    return found


class Structure(NamedTuple):
    """Which values depend on which: of each variable behind the parameters those of t, state, parameters and inputs."""

    dependencies: dict[int, frozenset[int]]
    derivatives: tuple[int, ...]  # of the state
    state: range
    is_constrained: bool


def model_description(name: str, model: str, token: str, tool: str, given: Sequence[Variable], structure: Structure) -> bytes:
    """The content of modelDescription.xml; `model` is the identifier."""
    root = xml.Element("fmiModelDescription", _attributes(
        fmiVersion="3.0", modelName=name, instantiationToken=token, generationTool=tool, variableNamingConvention="structured"
    ))  # fmt: skip
    yes = dict.fromkeys(
        ("canGetAndSetFMUState", "canSerializeFMUState", "providesDirectionalDerivatives", "providesAdjointDerivatives"), True
    )
    xml.SubElement(root, "ModelExchange", _attributes(
        modelIdentifier=model, needsExecutionTool=False, needsCompletedIntegratorStep=structure.is_constrained, **yes
    ))  # fmt: skip
    xml.SubElement(root, "CoSimulation", _attributes(
        modelIdentifier=model, needsExecutionTool=False, canHandleVariableCommunicationStepSize=True, hasEventMode=False, **yes
    ))  # fmt: skip
    if units := sorted({variable.unit for variable in given if variable.unit}):
        definitions = xml.SubElement(root, "UnitDefinitions")
        for unit in units:
            xml.SubElement(definitions, "Unit", name=unit)
    categories = xml.SubElement(root, "LogCategories")
    xml.SubElement(categories, "Category", _attributes(name="logStatusError", description="why a function has failed"))
    xml.SubElement(root, "DefaultExperiment", _attributes(tolerance=TOLERANCE))
    inside = xml.SubElement(root, "ModelVariables")
    for i, variable in enumerate(given):
        xml.SubElement(inside, "Float64", _of_variable(i, variable, structure))
    _model_structure(xml.SubElement(root, "ModelStructure"), given, structure)
    xml.indent(root)
    return xml.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"


def build_description(model: str) -> bytes:
    """The content of buildDescription.xml."""
    root = xml.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = xml.SubElement(root, "BuildConfiguration", modelIdentifier=model)
    files = xml.SubElement(configuration, "SourceFileSet", language="C99")
    xml.SubElement(files, "SourceFile", name="fmu.c")
    plain = _attributes(
        name="FMI3_OVERRIDE_FUNCTION_PREFIX", value=1, optional=True, description="functions without prefix: a shared library"
    )
    xml.SubElement(files, "PreprocessorDefinition", plain)
    xml.SubElement(configuration, "Library", name="m", external="true")
    xml.indent(root)
    return xml.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"


def _attributes(**values: Any) -> dict[str, str]:
    as_text = lambda value: str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, float) else str(value)
    return {name: as_text(value) for name, value in values.items() if value is not None}


def _of_variable(i: int, variable: Variable, structure: Structure) -> dict[str, str]:
    is_parameter = variable.causality == "parameter"
    initial = "calculated" if variable.start is None else "approx" if i in structure.state and structure.is_constrained else "exact"
    return _attributes(
        name=variable.name,
        valueReference=i,
        description=variable.description,
        causality=variable.causality,
        variability="tunable" if is_parameter else "continuous",
        initial=None if variable.causality in ("independent", "input") else initial,
        start=None if variable.start is None else float(variable.start),
        derivative=variable.derivative_of,
        unit=variable.unit,
    )


def _model_structure(root: xml.Element, given: Sequence[Variable], structure: Structure) -> None:
    """Outputs, derivatives of the state, and what is unknown at the start, each with what it depends on."""
    outputs = [i for i, variable in enumerate(given) if variable.causality == "output"]
    calculated = {i for i, variable in enumerate(given) if variable.start is None}
    approximate = set(structure.state) if structure.is_constrained else set()
    unknown = sorted((calculated | approximate) & ({*outputs} | {*structure.derivatives} | {*structure.state}))
    in_motion = lambda of: [j for j in of if given[j].causality != "parameter"]

    def add(kind: str, i: int, of: Iterable[int] | None) -> None:
        text = None if of is None else " ".join(map(str, sorted(of)))
        xml.SubElement(root, kind, _attributes(valueReference=i, dependencies=text))

    behind = lambda i: structure.dependencies.get(i, frozenset((i,)))
    for i in outputs:
        add("Output", i, in_motion(behind(i)))
    for i in structure.derivatives:
        add("ContinuousStateDerivative", i, in_motion(behind(i)))
    for i in unknown:
        add("InitialUnknown", i, None if structure.is_constrained else behind(i))
