"""Compiled code on disk: damaged files, folders that cannot be written, a full disk."""

import importlib
import os
import sys

import numpy as np
import pytest

from quad_gym.kernels.compiling import cache as caches
from quad_gym.kernels.compiling import entry, kernel, routine
from quad_gym.kernels.numbers.linalg import cross
from tests.unit.compiling.parts import PREPARE, RIGHT, Parts

FULL_DISK = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (500, 500))\n" + PREPARE


@pytest.fixture
def parts(tmp_path):
    return Parts(tmp_path)


@pytest.fixture
def module(parts, monkeypatch):
    """The module of entries, imported here."""
    monkeypatch.syspath_prepend(parts.folder)
    monkeypatch.setenv("NOTES", str(parts.notes))
    monkeypatch.setattr(caches.config, "CACHE_DIR", "")
    yield importlib.import_module("parts_of_test")
    del sys.modules["parts_of_test"]


def call(function):
    """Result of an entry of the module for (0, 5)."""
    x = np.array([0.0, 5.0])
    function(x)
    return x[0]


@pytest.mark.parametrize("decorator", [kernel, routine])
def test_python_cannot_call_a_kernel(decorator):
    def grows(x):
        return x + 1.0

    with pytest.raises(TypeError, match=r"grows is a kernel.*`entry`"):
        decorator(grows)(1.0)
    with pytest.raises(TypeError, match=r"cross is a kernel, which only compiled code can call"):
        cross((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


DOT = """
import numpy as np
import dot_of_test
x = np.array([0.0, 5.0])
dot_of_test.squares(x)
print(x[0])
"""
SQUARES = """
import numpy as np
from quad_gym.kernels.compiling import entry

@entry
def squares(x):
    x[0] = np.dot(x, x)
"""


def test_cached_code_with_blas_is_loaded_in_another_process(parts):
    (parts.folder / "dot_of_test.py").write_text(SQUARES)
    for said_something in (True, False):
        output, said = parts.run(DOT)
        assert output == "25.0"
        assert bool(said) == said_something


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:-1],
        lambda content: content[:99] + bytes([content[99] ^ 1]) + content[100:],
    ],
    ids=["empty", "cut off", "one bit"],
)
def test_a_damaged_file_is_compiled_again_and_replaced(module, parts, damage, capfd):
    assert call(module.a) == 11.0
    (file,) = parts.files("code")
    sound = file.read_bytes()
    file.write_bytes(damage(sound))
    capfd.readouterr()
    fresh = entry(module.sources["a"], module.SIGNATURE)
    assert not fresh.is_cached()
    assert call(fresh) == 11.0
    assert "compiling a (once; cached in" in capfd.readouterr().err
    assert parts.compiled() == ["a", "a"]
    assert fresh._cache.holds(module.SIGNATURE, fresh.targetctx)
    # sizes differ: names in the code have numbers, sometimes of one digit more
    assert len(file.read_bytes()) == pytest.approx(len(sound), abs=50)
    assert call(entry(module.sources["a"], module.SIGNATURE)) == 11.0
    assert parts.compiled() == ["a", "a"]


def test_stale_files_of_a_function_are_deleted(module, parts):
    call(module.a)
    (file,) = parts.files("code")
    old = [file.with_name(f"{file.name[: -len('.code') - 32]}{k:032x}.code") for k in range(12)]
    for k, path in enumerate(old):
        path.write_bytes(b"of older sources")
        os.utime(path, (k, k))
    left = file.with_name(f"{file.name[: -len('.code') - 33]}.tmp")
    left.write_bytes(b"of a killed process")
    call(module.b)
    assert len(parts.files("code")) == 14  # no files of another function are deleted
    file.unlink()
    call(entry(module.sources["a"], module.SIGNATURE))
    files = [path for path in parts.files("code") if ".a." in path.name]
    assert len(files) == caches.KEPT
    assert file in files
    assert old[-1] in files
    assert old[0] not in files
    assert not parts.files("tmp")


def test_without_a_folder_parts_are_compiled_in_the_process(parts):
    parts.cache.write_text("a file where the folder should be")
    nowhere = parts.folder / "notes" / "below a file"
    parts.notes.touch()
    output, said = parts.run(XDG_CACHE_HOME=str(nowhere), NUMBA_CACHE_DIR=str(nowhere))
    assert output == RIGHT
    assert parts.compiled() == ["a", "b", "c"]
    assert len(parts.compilers()) == 1
    assert "not cached: no folder can be written; set NUMBA_CACHE_DIR" in said
    assert len(said.splitlines()) == 2


def test_code_is_cached_in_the_users_folder_if_the_package_is_read_only(parts):
    parts.cache.write_text("a file where the folder should be")
    elsewhere = parts.folder / "elsewhere"
    for _ in range(2):
        output, said = parts.run(processes=1, XDG_CACHE_HOME=str(elsewhere))
        assert output == RIGHT
        assert parts.compiled() == ["a", "b", "c"]
    assert said == ""
    assert len(list(elsewhere.rglob("*.code"))) == 3


@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits on the size of files")
@pytest.mark.slow  # five processes; folders that cannot be written are tested above
def test_full_disk_gives_one_warning_and_no_cached_code(parts):
    output, said = parts.run(FULL_DISK)
    assert output == RIGHT
    lines = [line for line in said.splitlines() if "compiled code cannot be cached in" in line]
    assert len(lines) == 1
    assert "File too large" in lines[0]
    assert "Traceback" not in said
    assert not parts.files("code")
    assert not parts.files("tmp")
    assert parts.run(processes=1)[0] == RIGHT
    assert len(parts.files("code")) == 3


EDITED = """
import os
import sys
import time
if sys.argv[1:] == ["lagging clock"]:  # the clock of files lags behind this one by some ms
    now = time.time
    time.time = lambda: now() + 60.0
import parts_of_test as parts
from pathlib import Path
file, kept = Path(parts.__file__), os.stat(parts.__file__)
text = file.read_text()
assert text.count("x + x") == 1
file.with_suffix(".new").write_text(text.replace("x + x", "x * x * 1.0"))
if sys.argv[1:] == ["old time"]:
    os.utime(file.with_suffix(".new"), (kept.st_atime, kept.st_mtime))
file.with_suffix(".new").replace(file)
from quad_gym.kernels.compiling.workers import prepare
prepare(parts.NAMES, processes={processes})
print(parts.results())
"""


@pytest.mark.parametrize("when", ["new time", "old time", "lagging clock"])
def test_code_of_a_source_edited_after_its_import_is_not_kept(parts, when):
    """The first process compiles 2 x, which it has imported, and the others x^2, of the file."""
    if when == "old time" and sys.platform == "win32":
        pytest.skip("Windows does not show when a file was replaced")
    code = EDITED.replace("sys.argv[1:]", repr([when]))
    output, said = parts.run(code, processes=1)
    assert output == RIGHT
    assert "compiled code is not cached:" in said
    assert "parts_of_test.py has changed since it was imported" in said
    assert not parts.files("code")
    for known in (False, True):
        output, said = parts.run(processes=1)
        assert output == "[26.0, 27.0, 28.0]"
        assert bool(said) != known
