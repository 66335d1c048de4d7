"""Programs kept on disk with what they were made of, so that another process need not trace them either.

JAX's persistent cache finds a compiled program by the program, which has to be traced and lowered first: more than half of the time of a
second process. Here it is found by what it is traced from: the function of this package, the shapes of its arguments and all else that it
is given, the user's functions too, versions and settings. Where anything of that has no certain description, the program is traced as ever.
"""

import contextlib
import functools
import hashlib
import io
import os
import pickle
import platform
import sys
import tempfile
import warnings
import weakref
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef, default_registry

from .cache_of_jax import ELSEWHERE, compiled_afresh, loaded, written
from .description import NotDescribable, Words
from .registry import Table

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


class CompiledAgain(UserWarning):
    """Says that something is compiled again and again. Not needed for a program that is found."""


class KeptPrograms:
    """The programs in a folder, if one was chosen, and those of them that this process has found."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self._found = Table()
        self._mark: weakref.ref | None = None

    def keep_in(self, folder: Path | None) -> None:
        """From here on programs are kept in this folder, or in none, or none that cannot be written to."""
        self.folder = folder if folder is not None and os.access(folder, os.W_OK | os.X_OK) else None
        self._found.clear()

    def called(self, program: Any, function: Callable, arrays: list, static: Any) -> Any:
        """`program(arrays, static)`, from the folder if it is there, and into it if not."""
        if self._mark is None or self._mark() is None:  # after `jax.clear_caches()` nothing is left of what was found before
            self._found.clear()
            self._mark = _marked_in_caches()
        key = function, static, tuple(map(_kind, arrays)), _settings()
        if key not in self._found:
            self._found[key] = self._load_or_compile(program, function, arrays, static)
        found = self._found.get(key)
        return program(arrays, static) if found is None else found(arrays)

    def _load_or_compile(self, program, function, arrays, static):
        """The compiled program; None where it is left to JAX."""
        try:
            words = _words_for(function, arrays, static)
            if (found := _read(self.folder, words, arrays)) is not None:
                return found
            lowered = _lowered(program, arrays, static)
            head = _head(words, lowered.out_tree)
            with compiled_afresh():
                compiled = lowered.compile()
        except (NotDescribable, OSError, *ELSEWHERE):
            return None
        with contextlib.suppress(Exception):  # a full disk; a program that calls Python, which says so in many ways
            _write(self.folder / _name(words), head + written(compiled))
        return compiled


KEPT = KeptPrograms()


class _Mark:
    """What lives as long as JAX's caches are not cleared."""


def _marked_in_caches():
    mark = _Mark()
    jax.jit(lambda x, mark: x, static_argnums=1)(0, mark)
    return weakref.ref(mark)


def _lowered(program, arrays, static):
    """The lowered program. One that warns is left to JAX, as it is to warn in each process."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        lowered = program.lower(arrays, static)
    for w in given:
        warnings.warn_explicit(w.message, w.category, w.filename, w.lineno, source=w.source)
    if any(w.category is not CompiledAgain for w in given):
        raise NotDescribable("a program that warns")
    return lowered


def _words_for(function, arrays, static):
    """All that a program is made of."""
    if any(getattr(jax.config, name) for name in BY_HAND):
        raise NotDescribable("programs that the user looks into")
    if not static.has_words:
        raise NotDescribable("what may be anything")
    words, kinds = Words(), list(map(_kind, arrays))
    if any(len(kind) > 3 for kind in kinds):
        raise NotDescribable("arrays on other devices")
    words.say(_surroundings(), str(_settings()), str(kinds))
    words.value(function)
    static.describe(words)
    return words


def _name(words) -> str:
    """Of the file of a program."""
    return f"jaxlag-{words.digest()}-cache"


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


def _head(words, out_tree) -> bytes:
    """The beginning of the file of a program: the structure of what it returns."""
    content = io.BytesIO()
    try:
        _Pickler(content, words.objects).dump(out_tree)
        content.seek(0)
        if _Unpickler(content, words.objects).load() != out_tree:
            raise NotDescribable("something that is not the same when it is read again")
    except Exception as error:  # what cannot be pickled says so in many ways
        raise NotDescribable(str(error)) from error
    return content.getvalue()


def _write(path, content):
    """At once, as another process may read it; behind its digest."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        file = Path(folder) / path.name
        file.write_bytes(hashlib.sha256(content).digest() + content)
        os.replace(file, path)


def _read(folder, words, arrays):
    """The program in the folder that is asked for; None if there is none that can be read."""
    try:
        whole = (folder / _name(words)).read_bytes()
        digest, content = whole[:32], io.BytesIO(whole[32:])
        if hashlib.sha256(content.getbuffer()).digest() != digest:
            return None
        _have_lapack()
        out_tree = _Unpickler(content, words.objects).load()
        return loaded(content.read(), jax.tree.structure(((arrays,), {})), out_tree)
    except Exception:  # no file, or one of another kind; what was loaded would have been the same program
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
        """A structure node by node: by itself it can be pickled only if it is one of Python's own containers. A mark of a package is what
        stands there under its name.
        """
        if isinstance(x, PyTreeDef):
            return _node, (x.node_data(), x.children())
        names = [name for name, y in vars(sys.modules[type(x).__module__]).items() if y is x] if getattr(x, "__dict__", None) == {} else []
        return (_named, (type(x).__module__, names[0])) if names and not isinstance(x, type) else NotImplemented


def _node(data, children):
    return jax.tree.structure(0) if data is None else PyTreeDef.from_node_data_and_children(default_registry, data, children)


def _named(module, name):
    return getattr(sys.modules[module], name)


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
    processor, telling = Path("/proc/cpuinfo"), ("flags", "model", "Features", "CPU")
    lines = processor.read_text().splitlines() if processor.exists() else []
    flags = [line for line in lines if line.startswith(telling)][:8]
    compiler = os.environ.get("XLA_FLAGS", ""), jax.devices()[0].client.platform_version
    found.update(repr(([version(name) for name in VERSIONS], platform.uname()[:1], platform.machine(), flags, compiler)).encode())
    return f"{platform.python_version()} {found.hexdigest()}"
