"""Programs of the last time are read ahead, and are the same."""

import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax._core import kept, structure
from zoomjax._core.ahead import programs_ahead
from zoomjax._core.programs import light_program, optimised_program, program

from ._trees import equal


def doubled(x):
    """Made a program by the tests."""
    return {"twice": 2 * x, "text": "text"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder in which programs are kept; those of this module, too."""
    monkeypatch.setattr(structure, "KNOWN", (*structure.KNOWN, __name__.split(".")[0]))
    monkeypatch.setattr(kept, "_STORE", kept._Store(tmp_path))
    return tmp_path


def again(folder, monkeypatch):
    """As in a process that begins."""
    monkeypatch.setattr(kept, "_STORE", kept._Store(folder))


@pytest.mark.parametrize("kind", [program, light_program, optimised_program])
def test_what_was_used_the_last_time_is_ready(folder, monkeypatch, kind):
    with programs_ahead("a test"):
        first = kind(doubled)(jnp.arange(4.0))
    again(folder, monkeypatch)
    with programs_ahead("a test"):
        (begun,) = kept._STORE.ahead.values()
        _, compiled = begun.result()
        monkeypatch.setattr(kept, "opened", None)  # it is not read again
        equal(kind(doubled)(jnp.arange(4.0)), first)
        assert not kept._STORE.ahead
        assert compiled._cache_size() == 1
        equal(kind(doubled)(jnp.arange(4.0) + 1), doubled(np.arange(4.0) + 1))


@pytest.mark.parametrize("kind", [program, light_program, optimised_program])
def test_what_is_ready_is_not_compiled_again(folder, monkeypatch, compilations, kind):
    values = jnp.arange(4.0) + 1
    with programs_ahead("a test"):
        kind(doubled)(values)
    again(folder, monkeypatch)
    with programs_ahead("a test"):
        (begun,) = kept._STORE.ahead.values()
        begun.result()
        assert compilations() > 0
        kind(doubled)(values)
        assert compilations() == 0


def test_other_occasions_have_other_programs(folder, monkeypatch):
    with programs_ahead("a test"):
        program(doubled)(jnp.arange(4.0))
    again(folder, monkeypatch)
    with programs_ahead("another"):
        assert not kept._STORE.ahead
        program(doubled)(jnp.arange(5.0))
    assert len(list(folder.glob("*.used"))) == 2


@pytest.mark.parametrize(
    "text", ["", "no list", f"{'0' * 64} 9\n", f"{'0' * 64} 1\n../../lens 0\n", "\x00"]
)
def test_a_list_that_is_of_no_use_does_no_harm(folder, monkeypatch, text):
    with programs_ahead("a test"):
        first = program(doubled)(jnp.arange(4.0))
    (listed,) = folder.glob("*.used")
    listed.write_text(text)
    again(folder, monkeypatch)
    with programs_ahead("a test"):
        equal(program(doubled)(jnp.arange(4.0)), first)
    again(folder, monkeypatch)
    with programs_ahead("a test"):
        assert len(kept._STORE.ahead) == 1


def test_after_an_error_the_list_stays(folder):
    with programs_ahead("a test"):
        program(doubled)(jnp.arange(4.0))
    (listed,) = folder.glob("*.used")
    before = listed.read_text()
    with pytest.raises(KeyError), programs_ahead("a test"):
        raise KeyError
    assert listed.read_text() == before
    assert not kept._STORE.ahead


def test_where_no_programs_are_kept_nothing_is_noted(monkeypatch, tmp_path):
    monkeypatch.setattr(kept, "_STORE", kept._Store())
    with programs_ahead("a test"):
        program(doubled)(jnp.arange(4.0))
    assert not list(tmp_path.iterdir())
