"""Compiled programs that outlast the process: JAX's persistent compilation cache and ours, in a folder of the user's, of limited size."""

import contextlib
import errno
import os
import stat
import sys
import warnings
from pathlib import Path

import jax

from .cache_of_jax import read_settings
from .kept_programs import KEPT

SMALLEST = {  # programs of any size: a fit has dozens of small ones, which take longer to compile than to read
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": 0,
}


def keep_compiled(folder: str | os.PathLike | None = None, *, max_bytes: int = 2**30) -> Path:
    r"""Keeps compiled programs on disk, so that the next process reads them instead of compiling.

    Call it once, before the first motion. It sets JAX's persistent compilation cache for all programs of the process. On a CPU, calls from
    Python, such as `simulate`, a gradient of it and `fit`, skip tracing, too: the cache key is your functions, by their code and all that
    it refers to, with shapes, settings, and the versions of JAX and jaxlag. Functions that have a derivative rule of their own
    (`jax.custom_jvp`) or refer to what may be anything, such as an open file, and motions within your own `jit` are traced as usual. Only
    `simulate(..., progress=True)` compiles again, because the compiled program calls its progress bar.

    **Arguments:**

    - `folder`: where to keep them. Default: the folder that is already set by `JAX_COMPILATION_CACHE_DIR` or `jax.config`, otherwise the
      user's cache folder: `$XDG_CACHE_HOME/jaxlag` or `~/.cache/jaxlag` on Linux, `~/Library/Caches/jaxlag` on macOS and
      `%LOCALAPPDATA%\jaxlag` on Windows. It is created if necessary, for this user alone: whoever can write to it can run code in your
      processes. So a folder that others can write to is not used, with a warning.
    - `max_bytes`: if the folder is larger when this is called, the least recently used programs are deleted; a folder that was already set
      is left to its owner.

    JAX's smallest compile time of a kept program is set to zero, unless `JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS` is set.

    **Returns:** the folder.

    **Raises:** `ValueError` if the folder cannot be made or written to; `TypeError` if `folder` is no path, or `max_bytes` no whole
    number of 0 or more.

    **Source:** the guide of JAX, "Persistent compilation cache".

    ```python
    import jaxlag as jl
    folder = jl.keep_compiled()  # e.g. /home/ada/.cache/jaxlag
    ```
    """
    if not (folder is None or isinstance(folder, (str, os.PathLike))):
        raise TypeError(f'`folder` must be a path, but is {folder!r}. Write e.g. "~/programs", or leave it out.')
    if not (type(max_bytes) is int and max_bytes >= 0):
        raise TypeError(f"`max_bytes` must be a whole number of bytes, 0 or more, but is {max_bytes!r}. The default is 2**30.")
    for setting, value in SMALLEST.items():
        if setting.upper() not in os.environ:
            jax.config.update(setting, value)
    chosen = jax.config.values["jax_compilation_cache_dir"]
    if folder is None and chosen:
        if "://" not in chosen:  # JAX knows folders of the cloud, too
            with contextlib.suppress(OSError):
                Path(chosen).mkdir(mode=0o700, parents=True, exist_ok=True)
        KEPT.keep_in(Path(chosen) if _is_private(Path(chosen)) else None)
        return Path(chosen)
    path = _user_cache() / "jaxlag" if folder is None else Path(folder).expanduser().absolute()
    _make(path)
    if not _is_private(path):
        KEPT.keep_in(None)
        return path
    _shrink(path, max_bytes)
    if chosen != str(path):
        read_settings()
        jax.config.update("jax_compilation_cache_dir", str(path))
    KEPT.keep_in(path)
    return path


def _user_cache() -> Path:
    """The folder of the user's caches, by the conventions of the platform."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    of_xdg = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return of_xdg if of_xdg.is_absolute() else Path.home() / ".cache"  # a relative one has to be ignored


def _make(folder):
    """A folder that can be written to, private to the user if it is new."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise _unusable(folder, error.strerror) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise _unusable(folder, os.strerror(errno.EACCES))


def _is_private(folder):
    """Whether only this user can write to a folder; warns where others can."""
    if not hasattr(os, "getuid") or not folder.exists():  # Windows has other rights; in the cloud nothing of ours is kept
        return True
    found = folder.stat()
    if found.st_uid == os.getuid() and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return True
    warnings.warn(
        f"`folder` must be a folder that only you can write to, since the programs in it are run, but others can write to {folder}. "
        "Nothing is kept there. Take the right away from them, `chmod go-w`, or give another folder.",
        stacklevel=3,
    )
    return False


def _unusable(folder, reason):
    return ValueError(f"`folder` must be a folder that can be written to, but {folder} cannot: {reason}. Give another one.")


def _shrink(folder, max_bytes):
    """Deletes the programs that were used longest ago until the others take no more than `max_bytes`.

    JAX would do this itself, `jax_compilation_cache_max_size`, but with the package filelock, with a lock for every program that is read,
    and not in a folder with programs from a time without that setting.
    """
    programs = []
    for file in folder.glob("*-cache"):
        with contextlib.suppress(OSError):  # deleted by another process meanwhile
            found = file.stat()
            programs.append((max(found.st_atime, found.st_mtime), found.st_size, file))
    excess = sum(size for _, size, _ in programs) - max_bytes
    for _, size, file in sorted(programs):
        if excess <= 0:
            break
        with contextlib.suppress(OSError):  # another process has it open, on Windows
            file.unlink(missing_ok=True)
        excess -= size
