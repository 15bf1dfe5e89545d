"""Programs and the settings of their compiler."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax._core import programs
from zoomjax._core.programs import light_program, program, program_of_steps, rare_program


@pytest.fixture(autouse=True)
def own_settings(monkeypatch):
    """Without the flags of the tests, and what other tests found."""
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(programs, "_UNKNOWN", set())
    programs._settings.cache_clear()
    yield
    programs._settings.cache_clear()


def spread(values, *, power):
    return jnp.sum(jnp.sin(values) ** power)


@pytest.mark.parametrize("make", [program, light_program, program_of_steps, rare_program])
def test_program_gives_what_the_function_gives(make):
    values = np.linspace(0, 1, 9)
    compiled = make(spread)
    assert compiled.__name__ == "spread"
    expected = spread(values, power=2)
    np.testing.assert_allclose(compiled(values, power=2), expected, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(lambda v: compiled(v, power=2))(values), expected, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(lambda: compiled(values, power=2))(), expected, rtol=1e-14)
    slope = jax.grad(lambda v: compiled(v, power=2))(values)
    np.testing.assert_allclose(slope, jax.grad(lambda v: spread(v, power=2))(values), rtol=1e-14)
    rows = np.stack([values, 2 * values])
    every = jax.vmap(lambda v: compiled(v, power=2))(rows)
    np.testing.assert_allclose(every, [spread(row, power=2) for row in rows], rtol=1e-14)


def test_few_numbers_are_not_worth_optimisation():
    few, long = np.zeros(9), np.zeros(programs._ROWS + 1)
    many = np.zeros((2, programs._NUMBERS // 2 + 1))
    assert programs.are_few(((few, "name"), {"more": jnp.zeros(())}))
    assert not programs.are_few(((few, long), {}))
    assert not programs.are_few(((few, many), {}))
    small, larger = (dict(programs._settings(programs._kind(False, False, few))) for few in (True, False))
    assert small["xla_backend_optimization_level"] == 0
    assert larger["xla_backend_optimization_level"] == 1


def test_many_steps_are_compiled_without_emitters_by_a_process_that_runs_once(monkeypatch):
    def of(in_steps):
        return dict(programs._settings(programs._kind(True, in_steps, False)))

    assert of(True) == of(False) == {}
    monkeypatch.setattr(programs._USE, "once", True)
    assert of(True) == {"xla_cpu_use_fusion_emitters": False}
    assert of(False) == {}
    assert tuple(of(True).items()) in programs.all_settings()


def test_rare_programs_are_not_optimised_by_a_process_that_runs_once(monkeypatch):
    kinds, kind_of = [], programs._kind

    def kind_for(size):
        rare_program(spread)(np.ones(size), power=2)
        return kinds[-1]  # a version that does not know a setting asks again

    few, many = 9, programs._LARGER * programs._ROWS + 1
    with monkeypatch.context() as patch:
        patch.setattr(programs, "_kind", lambda *of: kinds.append(kind_of(*of)) or kinds[-1])
        assert kind_for(few) == "plain"
        patch.setattr(programs._USE, "once", True)
        assert kind_for(few) == "small"
        assert kind_for(many) == "plain"


def test_settings_of_the_environment_come_first(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=2")
    programs._settings.cache_clear()
    assert "xla_backend_optimization_level" not in dict(programs._settings("small"))


def test_settings_that_xla_does_not_know_are_left_away(monkeypatch):
    kinds = {name: {"xla_no_such_setting": True, **kind} for name, kind in programs._KINDS.items()}
    monkeypatch.setattr(programs, "_KINDS", kinds)
    assert float(program(lambda x: x + 1)(jnp.ones(()))) == 2
    assert "xla_no_such_setting" in programs._UNKNOWN  # others are, too, in some versions
    assert "xla_backend_optimization_level" in dict(programs._settings("plain"))


def test_other_errors_are_raised():
    failing = program(lambda x: eqx.error_if(x, x > 0, "too large"))
    with pytest.raises(eqx.EquinoxRuntimeError, match="too large"):
        failing(jnp.ones(()))


def test_nothing_is_set_on_other_devices(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert [*programs.all_settings()] == [()] * 4
