"""Programs that are compiled in threads: each once, and as if there were no threads."""

import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax._core import programs
from zoomjax._core.beside import compile_beside, wait_for
from zoomjax._core.programs import begin, program

pytestmark = pytest.mark.skipif(os.cpu_count() == 1, reason="one core compiles nothing beside")

FITS = """
import collections, sys, threading
import jax, numpy as np, zoomjax as zj
jax.config.update("jax_enable_x64", sys.argv[1] == "float64")
compiled, own = [], threading.get_ident()
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, fun_name="", **_: compiled.append((fun_name, threading.get_ident() == own))
    if "backend_compile" in event else None
)
lens = zj.scenes.nikkor_18_200()
lines = zj.compress(zj.scenes.board_lines(lens, zj.scenes.focal_sweep(6), spacing=200, noise=0.2))
for fit in (zj.fit_zoom, zj.fit_frames):
    compiled.clear()
    first = fit(lines, throw=False)
    names = [name for name, _ in compiled]
    assert len(set(names)) == len(names), names  # nothing twice
    print(*sorted(name for name, here in compiled if not here))
    number = len(compiled)
    again = fit(lines, throw=False)
    assert len(compiled) == number
    same = jax.tree.map(lambda a, b: np.array_equal(a, b, equal_nan=True), first, again)
    assert all(jax.tree.leaves(same))
"""


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_programs_of_fits_are_compiled_beside_and_none_twice(dtype):
    command = [sys.executable, "-W", "error", "-c", FITS, dtype]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stderr) == (0, "")
    zoom, frames = done.stdout.splitlines()
    assert {"jit(fit_without_covariance)", "jit(minimise)"} <= set(zoom.split())
    assert {"jit(_described)", "jit(_minima)"} <= set(frames.split())


@pytest.fixture
def compiled():
    """In which threads a program of this name was compiled."""
    found = []

    def listen(event, seconds, fun_name="", **_):
        if "backend_compile" in event and "add_beside" in fun_name:
            found.append(threading.get_ident())

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield found
    jax.monitoring.unregister_event_duration_listener(listen)


def of_sum(trace=lambda: None):
    def add_beside(x, y):
        trace()
        return x + y

    return program(add_beside)


HERE = threading.get_ident()
NUMBERS = np.arange(3.0), np.ones(3)


def test_it_is_compiled_elsewhere_and_called_here(compiled):
    program(jnp.sin)(1.0)  # settings that this XLA does not know are known from then on
    add = of_sum()
    begin((add, NUMBERS))
    assert np.array_equal(add(*NUMBERS), [1, 2, 3])
    assert len(compiled) == 1
    assert compiled[0] != HERE
    begin((add, NUMBERS))
    add(*NUMBERS)
    assert len(compiled) == 1


def test_other_settings_of_this_thread_hold(compiled):
    """JAX's contexts are of one thread: another would compile another program."""
    add = of_sum()
    with jax.enable_x64(not jax.config.jax_enable_x64):
        begin((add, NUMBERS))
        found = add(*NUMBERS)
    assert found.dtype != jnp.zeros(()).dtype
    assert compiled == [HERE]


def test_nothing_is_begun_inside_of_jit():
    before = set(programs._GIVEN)
    add = of_sum()

    @jax.jit
    def twice(x):
        begin((add, (x, x)))
        return add(x, x)

    assert np.array_equal(twice(np.ones(3)), [2, 2, 2])
    assert before == programs._GIVEN


def test_an_error_is_that_of_the_call():
    def fails():
        raise ValueError("not these")

    add = of_sum(fails)
    begin((add, NUMBERS))
    with pytest.raises(ValueError, match="not these"):
        add(*NUMBERS)


def test_what_is_traced_beside_does_not_wait_for_itself():
    """It may run the very programs that are compiled after it."""
    reached = threading.Event()

    def lower():
        wait_for("second")
        reached.set()

    compile_beside([("first", lower), ("second", lambda: None)])
    assert reached.wait(60)
    wait_for("first")
    wait_for("second")


def test_without_threads_nothing_is_waited_for(monkeypatch):
    def start(self):
        raise RuntimeError("can't start new thread")

    add = of_sum()
    monkeypatch.setattr(threading.Thread, "start", start)
    begin((add, NUMBERS))
    assert np.array_equal(add(*NUMBERS), [1, 2, 3])
