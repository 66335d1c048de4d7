"""JAX's persistent compilation cache, and compiled programs as bytes: parts of JAX that may change, each used here alone."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import jax

ELSEWHERE = (ImportError, AttributeError, KeyError)  # raised where such a part is no longer what it was: then nothing is kept

_ONE_AT_A_TIME = threading.Lock()


def read_settings() -> None:
    """Has JAX look at the settings of its cache, which it does only once by itself."""
    with contextlib.suppress(*ELSEWHERE):
        from jax.experimental.compilation_cache import compilation_cache

        compilation_cache.reset_cache()


@contextlib.contextmanager
def compiled_afresh() -> Iterator[None]:
    """Without JAX's cache: XLA writes down only half of a program that it has not compiled but read. What another thread compiles
    meanwhile is not kept either.
    """
    with _ONE_AT_A_TIME:
        before = jax.config.values["jax_enable_compilation_cache"]
        try:
            jax.config.update("jax_enable_compilation_cache", False)
            read_settings()
            yield
        finally:
            jax.config.update("jax_enable_compilation_cache", before)
            read_settings()


def written(compiled: Any) -> bytes:
    """A compiled program."""
    from jax.experimental import serialize_executable

    return serialize_executable.serialize(compiled)[0]


def loaded(content: bytes, in_tree: Any, out_tree: Any) -> Callable:
    """The program that was written."""
    from jax.experimental import serialize_executable

    return serialize_executable.deserialize_and_load(content, in_tree, out_tree, execution_devices=jax.devices()[:1])
