"""Programs that an earlier process traced."""

import functools
import os
import subprocess
import sys
import zlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax._core import kept, structure
from zoomjax._core.programs import program

from ..conftest import keep_programs
from ._trees import equal


def plain(x, y=1):
    """Made a program by the tests."""
    return {"sum": x + y, "all": [x.sum(), None, "text", 2.5, y]}


def calling(x):
    return eqx.error_if(x, x > 1, "too large")


def weak(x):
    return jnp.where(x > 0, 1.0, 2.0)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder in which programs are kept; those of this module, too."""
    monkeypatch.setattr(structure, "KNOWN", (*structure.KNOWN, __name__.split(".")[0]))
    monkeypatch.setattr(kept, "_STORE", kept._Store(tmp_path))
    return tmp_path


@pytest.fixture
def traced(monkeypatch):
    """The names of the functions that are traced to be kept."""
    names, trace = [], kept._traced
    monkeypatch.setattr(
        kept, "_traced", lambda function, *of: (names.append(function.__name__), trace(function, *of))[1]
    )
    return names


def again():
    """As in a process that begins."""
    kept._STORE.calls.clear()


def test_a_program_is_traced_once_for_all_processes(folder, traced):
    function = program(plain)
    first = function(jnp.arange(4.0), y=2)
    again()
    equal(function(jnp.arange(4.0), y=2), first)
    assert traced == ["plain"]
    assert len(list(folder.glob("*.traced"))) == 1


def test_what_takes_its_results_is_compiled_once(folder):
    """JAX has two programs for arrays that are committed to a device and for others."""
    taking = jax.jit(lambda x: 2 * x)
    for x in (jnp.arange(4.0), program(plain)(jnp.arange(4.0))["sum"]):
        assert not x.committed
        taking(x)
    assert taking._cache_size() == 1


@pytest.mark.parametrize(
    "other",
    [
        lambda f: f(jnp.arange(5.0)),
        lambda f: f(jnp.arange(4)),
        lambda f: f(jnp.arange(4.0), 2),
        lambda f: f(jnp.arange(4.0), 1.0),
        lambda f: f(jnp.arange(4.0), True),
        lambda f: f(jnp.arange(4.0), y=1),
        lambda f: f(jnp.arange(4.0), jnp.asarray(1.0)),
        lambda f: f(jnp.arange(4.0), jnp.asarray(1.0, float)),
        lambda f: f(jnp.arange(4.0, dtype=jnp.float32)),
    ],
)
def test_other_arguments_are_another_program(folder, traced, other):
    function = program(plain)
    function(jnp.arange(4.0), 1)
    for _ in range(2):
        equal(other(function), other(plain))
        again()
    assert traced == ["plain", "plain"]


def test_other_settings_are_another_program(folder, traced):
    function, x = program(plain), np.arange(4, dtype=np.float32)
    function(x)
    with (
        jax.experimental.disable_x64()
        if hasattr(jax.experimental, "disable_x64")
        else jax.enable_x64(False)
    ):
        function(x)
    assert traced == ["plain", "plain"]


def test_another_version_is_another_program(folder, traced, monkeypatch):
    function = program(plain)
    function(np.ones(2))
    monkeypatch.setattr(kept, "_versions", lambda: "another")
    again()
    function(np.ones(2))
    assert traced == ["plain", "plain"]


@pytest.mark.parametrize(
    "content", [b"", b"poison", zlib.compress(b"null"), zlib.compress(b'["array"]\nprogram')]
)
def test_what_cannot_be_read_is_traced_anew(folder, traced, content):
    function = program(plain)
    first = function(np.ones(3))
    (file,) = folder.glob("*.traced")
    whole = file.read_bytes()
    file.write_bytes(content)
    again()
    equal(function(np.ones(3)), first)
    assert traced == ["plain", "plain"]
    assert kept._read(file) is not None
    assert len(file.read_bytes()) > len(whole) / 2


def test_a_program_under_the_name_of_another_is_traced_anew(folder, traced):
    function, x = program(plain), jnp.arange(3.0)
    wanted = [function(x, y) for y in (1, 2)]
    first, second = sorted(folder.iterdir())
    kept_first = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(kept_first)
    again()
    equal([function(x, y) for y in (1, 2)], wanted)
    assert traced == ["plain"] * 4
    again()
    equal([function(x, y) for y in (1, 2)], wanted)
    assert len(traced) == 4


def test_files_cut_off_anywhere_are_no_harm(folder):
    function = program(plain)
    first = function(np.ones(3))
    (file,) = folder.glob("*.traced")
    whole = file.read_bytes()
    for end in np.linspace(0, len(whole) - 1, 12).astype(int):
        file.write_bytes(whole[:end])
        again()
        equal(function(np.ones(3)), first)


def test_programs_that_call_python_do_so_still(folder, traced):
    function = program(calling)
    for _ in range(2):
        assert float(function(jnp.asarray(1.0, float))) == 1
        with pytest.raises(eqx.EquinoxRuntimeError, match="too large"):
            function(jnp.asarray(2.0, float))
        again()
    assert traced == ["calling"]  # a later process does not try again


def test_weak_types_stay_weak(folder):
    function = program(weak)
    for _ in range(2):
        assert function(jnp.ones(2)).weak_type
        again()


def test_functions_from_elsewhere_are_not_kept(folder, traced, monkeypatch):
    monkeypatch.setattr(structure, "KNOWN", ("zoomjax",))
    assert float(program(plain)(jnp.ones(1))["sum"][0]) == 2
    assert traced == []


def twice(function):
    """A decorator, whose function is another program than the one that it wraps."""
    return functools.wraps(function)(lambda x: 2 * function(x))


def doubled(x):
    return x + 1


inner = doubled
doubled = twice(doubled)


def test_functions_that_one_cannot_find_are_not_kept(folder, traced):
    power = 3
    assert float(program(lambda x: x**power)(jnp.asarray(2.0, float))) == 8
    assert [float(program(lambda x, n=n: x * n)(jnp.asarray(1.0, float))) for n in (2, 3)] == [2, 3]
    assert traced == []


def test_a_function_and_what_decorators_make_of_it_are_two(folder, traced):
    x = jnp.asarray(1.0, float)
    for _ in range(2):
        assert (float(program(inner)(x)), float(program(doubled)(x))) == (2, 4)
        again()
    assert len(traced) == 2


def test_errors_of_arguments_are_raised_as_they_are(folder):
    with pytest.raises((TypeError, ValueError), match=r"[Ii]ncompatible|broadcast"):
        program(plain)(jnp.ones(2), jnp.ones(3))
    assert not list(folder.iterdir())


def test_a_program_that_changed_after_it_was_read_is_not_kept(folder, traced, monkeypatch):
    monkeypatch.setattr(kept, "_BEGAN", 0.0)
    kept._versions.cache_clear()
    try:
        assert float(program(plain)(jnp.ones(1))["sum"][0]) == 2
    finally:
        kept._versions.cache_clear()
    assert traced == []


def test_keys_of_random_numbers_are_arguments_as_others(folder):
    jax.random.key_data(program(drawn)(jax.random.key(0)))


def drawn(key):
    return jax.random.fold_in(key, 1)


@pytest.mark.parametrize("name", kept._FINDING_ERRORS)
def test_nothing_is_kept_where_jax_is_to_find_errors(folder, traced, monkeypatch, name):
    jax.config.update(name, True)
    try:
        assert float(program(plain)(jnp.ones(1))["sum"][0]) == 2
    finally:
        jax.config.update(name, False)
    assert traced == []


def test_other_settings_of_equinox_are_another_program(folder, traced, monkeypatch):
    function = program(plain)
    for value in ("raise", "nan"):
        monkeypatch.setenv("EQX_ON_ERROR", value)
        function(jnp.ones(2))
    assert traced == ["plain", "plain"]


def test_a_file_whose_time_cannot_be_set_is_read(folder, traced, monkeypatch):
    function = program(plain)
    function(np.ones(3))
    again()

    def refused(*_):
        raise PermissionError

    monkeypatch.setattr(os, "utime", refused)
    function(np.ones(3))
    assert traced == ["plain"]


def test_few_programs_are_at_hand(folder, traced, monkeypatch):
    monkeypatch.setattr(kept, "_CALLS", 3)
    for size in (1, 2, 3, 4, 5, 5, 1):
        program(plain)(np.ones(size))
    assert len(kept._STORE.calls) == 3
    assert traced == ["plain"] * 5


@pytest.mark.parametrize("missing", ["flatbuffers", "jax.export"])
def test_nothing_is_kept_where_jax_cannot_write_programs(folder, traced, monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    keep_programs(folder)
    assert float(program(plain)(jnp.ones(1))["sum"][0]) == 2
    assert not traced
    assert not list(folder.iterdir())


def test_a_folder_that_is_gone_is_no_harm(folder):
    folder.rmdir()
    assert float(program(plain)(jnp.ones(1))["sum"][0]) == 2
    folder.mkdir()


def test_the_oldest_are_removed_where_all_are_too_many(folder, monkeypatch):
    monkeypatch.setattr(kept, "_MOST", 250)
    for number in range(4):
        file = folder / f"{number}.traced"
        file.write_bytes(bytes(100))
        os.utime(file, (number, number))
    (folder / "whole-cache").write_bytes(bytes(500))
    kept._remove_oldest(folder)
    assert sorted(os.listdir(folder)) == ["2.traced", "3.traced", "whole-cache"]


def test_inside_of_other_programs_nothing_is_kept(folder, traced):
    function = program(plain)
    jax.jit(lambda x: function(x)["sum"])(jnp.ones(2))
    jax.vmap(lambda x: function(x)["sum"])(jnp.ones((2, 2)))
    assert traced == []


@pytest.mark.slow
def test_fits_are_the_same_to_the_last_bit(small, folder, traced, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(kept, "_STORE", kept._Store())
        plainly = zj.fit_zoom(small, terms=1)
    for _ in range(2):
        equal(zj.fit_zoom(small, terms=1), plainly)
        again()
    assert len(traced) == len(set(traced)) >= 3


DEVICES = """
import jax, jax.numpy as jnp, sys
from pathlib import Path
from zoomjax._core import kept, structure
from zoomjax.fit._linear import triangle_of
from zoomjax._core.programs import program
kept.keep_programs(Path(sys.argv[1]))
other = jax.device_put(jnp.eye(3), jax.devices()[1])
found = program(triangle_of)(other)
assert found.devices() == {jax.devices()[1]}, found.devices()
print(len(list(Path(sys.argv[1]).iterdir())))
program(triangle_of)(jnp.eye(3))
print(len(list(Path(sys.argv[1]).iterdir())))
"""


def test_nothing_is_kept_where_there_are_several_devices(tmp_path):
    own = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    done = subprocess.run(
        [sys.executable, "-c", DEVICES, str(tmp_path)], env=own, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["0", "0"]
