"""Programs kept on disk with what they were made of, so that another process need not trace them either.

JAX's persistent cache finds a compiled program by the program, which has to be traced and lowered first: more than half of the time of a
second process. Here it is found by what it is traced from: the function of this package, the shapes of its arguments and all else that it
is given, versions and settings; and, for each of the user's functions, what it returns for each kind of arguments, as a program of JAX.
Where anything of that has no certain description, the program is traced as ever.
"""

import contextlib
import functools
import hashlib
import io
import os
import pickle
import platform
import tempfile
import threading
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jax.tree_util import PyTreeDef, default_registry

from .description import NotDescribable, Words
from .user_calls import LEDGER, Call

PACKAGE = Path(__file__).parents[1]
VERSIONS = ("jax", "jaxlib", "diffrax", "equinox", "optimistix", "lineax", "optax", "numpy", "scipy")
SETTINGS = (  # of JAX, that a program depends on
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_enable_x64",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_random_seed_offset",
    "jax_softmax_custom_jvp",
    "jax_threefry_partitionable",
)
BY_HAND = ("jax_debug_infs", "jax_debug_nans", "jax_default_device", "jax_disable_jit")  # with one of these a user looks into programs
MOST = 128  # programs that a process finds again at once; one has some megabytes


class KeptPrograms:
    """The programs in a folder, if one was chosen, and those of them that this process has found."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self._found: dict[Any, Callable | None] = {}

    def keep_in(self, folder: Path | None) -> None:
        """From here on programs are kept in this folder, or in none."""
        self.folder, LEDGER.is_open = folder, folder is not None
        self._found.clear()

    def called(self, program: Any, function: Callable, arrays: list, static: Any) -> Any:
        """`program(arrays, static)`, from the folder if it is there, and into it if not."""
        key = function, static, tuple(map(_kind, arrays)), _settings()
        if key not in self._found:
            while len(self._found) >= MOST:
                del self._found[next(iter(self._found))]
            self._found[key] = self._load_or_compile(program, function, arrays, static)
        found = self._found[key]
        return program(arrays, static) if found is None else found(arrays)

    def _load_or_compile(self, program, function, arrays, static):
        try:
            words = _words_for(function, arrays, static)
        except NotDescribable:
            return None
        for file in sorted(self.folder.glob(f"jaxlag-{words.digest()}-*-cache")):
            if (found := _read(file, words, arrays)) is not None:
                return found
        lowered = program.lower(arrays, static)
        try:
            name, head = _head(words, lowered.out_tree)
        except NotDescribable:
            return lowered.compile()
        with _compiled_afresh():
            compiled = lowered.compile()
        with contextlib.suppress(OSError, ValueError, NotImplementedError):  # a full disk; a program that calls Python
            _write(self.folder / name, head + serialize_executable.serialize(compiled)[0])
        return compiled


KEPT = KeptPrograms()


def _words_for(function, arrays, static):
    """All that a program is made of but the user's functions, which are listed."""
    if any(getattr(jax.config, name) for name in BY_HAND):
        raise NotDescribable("programs that the user looks into")
    words = Words()
    words.say(_surroundings(), str(_settings()))
    words.value(function)
    if words.functions:
        raise NotDescribable("a function that its name does not tell")
    for array in arrays:
        kind = _kind(array)
        if len(kind) > 3:
            raise NotDescribable("arrays on other devices")
        words.say(str(kind))
    leaves, structure = static
    words.value(leaves)
    words.structure(structure)
    return words


def _kind(array):
    """What a program is compiled for; behind it the devices, where they are not the first one alone."""
    if array is None:
        return (None,)
    if not isinstance(array, jax.Array):
        return np.shape(array), array.dtype, False
    elsewhere = () if array.sharding == _first_device() else (array.sharding,)
    return array.shape, array.dtype, array.weak_type, *elsewhere


@functools.cache
def _first_device():
    return jax.sharding.SingleDeviceSharding(jax.devices()[0])


def _answers(words, calls: list[tuple[Call, ...]]) -> str:
    """What the user's functions return for these calls, as a digest."""
    if not all(calls) or len(calls) != len(words.functions):
        raise NotDescribable("a function of the user's that is called in no known way")
    returned = Words()
    for function, of_function in zip(words.functions, calls, strict=True):
        for call in of_function:
            returned.answer(function, call)
    return returned.digest()


def _head(words, out_tree) -> tuple[str, bytes]:
    """Name and beginning of the file of a program: what is given and what the user's functions return, how they are called, what it
    returns itself.
    """
    calls = [LEDGER.of(function) for function in words.functions]
    name, content = f"jaxlag-{words.digest()}-{_answers(words, calls)}-cache", io.BytesIO()
    try:
        for part in (calls, out_tree):
            _Pickler(content, words.objects).dump(part)
    except Exception as error:  # what cannot be pickled says so in many ways
        raise NotDescribable(str(error)) from error
    return name, content.getvalue()


_ONE_AT_A_TIME = threading.Lock()


@contextlib.contextmanager
def _compiled_afresh() -> Iterator[None]:
    """Without JAX's cache: XLA writes down only half of a program that it has not compiled but read."""
    with _ONE_AT_A_TIME:
        before = jax.config.values["jax_enable_compilation_cache"]
        try:
            jax.config.update("jax_enable_compilation_cache", False)
            compilation_cache.reset_cache()  # JAX looks at the setting only once
            yield
        finally:
            jax.config.update("jax_enable_compilation_cache", before)
            compilation_cache.reset_cache()


def _write(path, content):
    """At once, as another process may read it."""
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        file.write(content)
    os.replace(file.name, path)


def _read(file, words, arrays):
    """The program in a file, if it is the one that is asked for; None if not, or if it cannot be read."""
    _have_lapack()
    try:
        with file.open("rb") as content:
            answers = _answers(words, _Unpickler(content, words.objects).load())
            if not file.name.endswith(f"-{answers}-cache"):
                return None
            out_tree, payload = _Unpickler(content, words.objects).load(), content.read()
        in_tree = jax.tree.structure(((arrays,), {}))
        return serialize_executable.deserialize_and_load(payload, in_tree, out_tree, execution_devices=jax.devices()[:1])
    except Exception:  # a damaged file; or the user's functions are other ones, which may do anything with such arguments
        return None


@functools.cache
def _have_lapack() -> None:
    """JAX looks for the functions of LAPACK when it lowers the first program that calls one, and what is loaded was lowered elsewhere."""
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((2, 2), float))


class _Pickler(pickle.Pickler):
    """Has for each object that a program is made of its number."""

    def __init__(self, file, objects):
        super().__init__(file)
        self.numbers = {id(x): i for i, x in enumerate(objects)}

    def persistent_id(self, x):
        return self.numbers.get(id(x))

    def reducer_override(self, x):
        """A structure node by node: by itself it can be pickled only if it is one of Python's own containers."""
        return (_node, (x.node_data(), x.children())) if isinstance(x, PyTreeDef) else NotImplemented


def _node(data, children):
    return jax.tree.structure(0) if data is None else PyTreeDef.from_node_data_and_children(default_registry, data, children)


class _Unpickler(pickle.Unpickler):
    def __init__(self, file, objects):
        super().__init__(file)
        self.objects = objects

    def persistent_load(self, number):
        return self.objects[number]


def _settings():
    return tuple(getattr(jax.config, name) for name in SETTINGS) + tuple(bool(getattr(jax.config, name)) for name in BY_HAND)


@functools.cache
def _surroundings() -> str:
    """Versions, this package to the letter, and the processor."""
    found = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        found.update(file.read_bytes())
    processor = Path("/proc/cpuinfo")
    flags = [line for line in processor.read_text().splitlines() if line.startswith(("flags", "model"))][:4] if processor.exists() else []
    compiler = os.environ.get("XLA_FLAGS", ""), jax.devices()[0].client.platform_version
    found.update(repr(([version(name) for name in VERSIONS], platform.uname()[:1], platform.machine(), flags, compiler)).encode())
    return f"{platform.python_version()} {found.hexdigest()}"
