"""How kernels are compiled: one decorator, one cache.

`@kernel` marks a function that other kernels call; `@entry` one that Python calls. Entries are
cached on disk. Numba's own cache notices a change in the file of an entry only, not in the kernels
that the entry calls from other files, so this cache is stamped with the sources of all kernels.
"""

import functools
import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}


def kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` into the entry that calls it, always inlined.

    A kernel left out of line would exist twice in a process that compiles, as the copy within the
    entry's code and as one by itself, whose multiply-adds LLVM may fuse otherwise; which of the two
    is called would depend on whether the entry was compiled or loaded, and flights would differ in
    their last bits from process to process.
    """
    return numba.njit(forceinline=True, **_OPTIONS)(function)


def entry(function: Callable[..., Any]) -> Any:
    """Compile `function` for calls from Python: cached on disk, running without the GIL."""
    dispatcher = numba.njit(nogil=True, **_OPTIONS)(function)
    try:
        dispatcher._cache = _KernelCache(function)
    except RuntimeError:  # no cache folder is writable: compile anew in every process
        dispatcher._cache = _NoCache(function.__name__)
    return dispatcher


@functools.cache
def sources_digest() -> str:
    """A digest of every file that shapes the compiled code."""
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    constants = (
        "records.py",
        "settings_fields.py",
        "late_fields.py",
        "params.py",
        "sensor_params.py",
        "distributions.py",
        "randomization.py",
        "world_fields.py",
        "fault_fields.py",
    )
    for path in (*sorted(package.glob("*.py")), *(package.parent / name for name in constants)):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def _announce(name: str, cached_in: str) -> None:
    print(
        f"quad_gym: compiling {name} for this machine (once, some minutes; {cached_in})",
        file=sys.stderr,
        flush=True,
    )


class _KernelSources:
    """Mixin for a cache locator: the stamp is that of all kernels."""

    def get_source_stamp(self) -> str:
        return sources_digest()


class _UserProvided(_KernelSources, caching.UserProvidedCacheLocator):
    """The folder that NUMBA_CACHE_DIR names."""


class _InTree(_KernelSources, caching.InTreeCacheLocator):
    """`__pycache__` beside the kernels."""


class _UserWide(_KernelSources, caching.UserWideCacheLocator):
    """The user's cache folder, where the package itself is read-only."""


class _KernelCacheImplementation(caching.CompileResultCacheImpl):
    _locator_classes = (_UserProvided, _InTree, _UserWide)


class _KernelCache(caching.Cache):
    _impl_class = _KernelCacheImplementation

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling a damaged file raises, it is as good as none
            found = None
        if found is None:
            _announce(self._py_func.__name__, f"cached in {self.cache_path}")
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            print(f"quad_gym: the compiled kernel was not cached: {error}", file=sys.stderr)
        except Exception:  # the index is damaged: begin a new one
            Path(self._cache_file._index_path).unlink(missing_ok=True)
            super().save_overload(sig, data)


class _NoCache(caching.NullCache):
    def __init__(self, name: str) -> None:
        self._name = name

    def load_overload(self, sig: Any, target_context: Any) -> None:
        _announce(self._name, "not cached, as no cache folder is writable; set NUMBA_CACHE_DIR")
