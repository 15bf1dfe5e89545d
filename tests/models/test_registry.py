"""Users' zoom models and distortion models in lens.json."""

import json
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

from .._own_models import Halved, LogZoom, own_lens
from ..fit.test_zoom import distorted_lines

READER = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import zoomjax as zj
{more}
lens = zj.load_lens(sys.argv[1])
print(lens.zoom.powers, type(lens.distortion_model).__name__)
print(*lens(33.0).undistort([[0.0, 0.0], [600.0, 400.0]]).ravel().tolist())
"""


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "lens.json"
    own_lens().save(path)
    return path


def read_elsewhere(path, more=""):
    """By a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", READER.format(more=more), str(path)],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[1],
        check=False,
    )


def test_a_lens_of_users_own_models_is_loaded_in_another_process(saved):
    done = read_elsewhere(saved, "import _own_models")
    assert done.returncode == 0, done.stderr
    kinds, numbers = done.stdout.splitlines()
    assert kinds == "(0, 1) Halved"
    expected = own_lens()(33.0).undistort(np.array([[0.0, 0.0], [600.0, 400.0]]))
    np.testing.assert_array_equal(np.fromstring(numbers, sep=" "), np.ravel(expected))


def test_without_their_module_a_sentence_says_what_is_missing(saved):
    done = read_elsewhere(saved)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert (
        "'LogZoom', is unknown: import the module that registers it by zoomjax.models.register_model"
        in last
    )
    content = json.loads(saved.read_text())
    content["zoom"]["model"] = "PolynomialZoom"
    content["zoom"] |= {"degree": 1, "focal_ref": 20.0}
    saved.write_text(json.dumps(content))
    assert "'half-polynomial', is unknown: import the module" in read_elsewhere(saved).stderr


def test_the_file_says_what_the_numbers_mean(saved):
    content = json.loads(saved.read_text())
    assert content["zoom"]["model"] == "LogZoom"
    assert content["zoom"]["formula"] == LogZoom.formula
    assert content["zoom"]["powers"] == [0, 1]
    assert content["distortion_model"] == "half-polynomial"
    assert content["radial"] == Halved.formula


def test_every_field_comes_back(saved):
    assert eqx.tree_equal(zj.load_lens(saved), own_lens())


def test_they_are_fitted_and_certified_through_the_public_pieces(tmp_path):
    lens = own_lens()
    lines = distorted_lines(lens, np.array([20.0, 30.0, 45.0, 80.0]), offset=150.0)
    fit = zj.fit_zoom(lines, zoom=LogZoom(), distortion_model=Halved())
    assert fit.certificate.certified
    np.testing.assert_allclose(fit.lens.zoom.parameters, lens.zoom.parameters, atol=1e-6)
    fit.lens.save(tmp_path / "fitted.json")
    assert eqx.tree_equal(zj.load_lens(tmp_path / "fitted.json"), fit.lens)


def model(**body):
    """A class of a zoom model, in a module of its own."""

    def prepare(self, focal, terms):
        return self

    def call(self, focal):
        return jnp.zeros(2)

    body = {"__module__": "elsewhere", "prepare": prepare, "__call__": call, "formula": "k = 0"} | body
    body["__annotations__"] = {"formula": ClassVar[str], "parameters": jax.Array | None} | body.pop(
        "more", {}
    )
    return type(zj.models.AbstractZoom)(
        body.pop("name", "Still"), (zj.models.AbstractZoom,), {"parameters": None} | body
    )


@pytest.fixture
def registry(monkeypatch):
    """What is registered in a test is forgotten after it."""
    from zoomjax.models import registry as models

    monkeypatch.setattr(models, "_ZOOMS", dict(models._ZOOMS))
    monkeypatch.setattr(models, "_DISTORTION_MODELS", dict(models._DISTORTION_MODELS))


def test_what_cannot_be_registered(registry):
    for thing in (3, zj.ZoomLens, zj.PolynomialZoom()):
        with pytest.raises(TypeError, match="class of AbstractZoom or AbstractDistortionModel"):
            zj.models.register_model(thing)
    with pytest.raises(TypeError, match="Still needs a class attribute formula"):
        zj.models.register_model(model(formula=None))
    with pytest.raises(TypeError, match="must not have a field model"):
        zj.models.register_model(model(more={"model": int}, model=3))
    with pytest.raises(ValueError, match="Another class is registered as 'PolynomialZoom'"):
        zj.models.register_model(model(name="PolynomialZoom"))
    zj.models.register_model(name="Other")(model(name="PolynomialZoom"))


def test_a_class_that_is_defined_again_takes_its_place(registry, tmp_path):
    zj.models.register_model(model())
    again = zj.models.register_model(model())
    lens = zj.ZoomLens(again(), jnp.zeros(2), jnp.array([20.0, 80.0]), (640, 480))
    lens.save(tmp_path / "lens.json")
    assert type(zj.load_lens(tmp_path / "lens.json").zoom) is again


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (object(), "its field extra is no array of real numbers, but a object"),
        ({"a": 1.0}, "its field extra is no array of real numbers, but a dict"),
        (jnp.array([1j]), "its field extra is no array of real numbers"),
    ],
)
def test_fields_that_json_cannot_hold_are_named_and_leave_no_file(value, message, registry, tmp_path):
    cls = zj.models.register_model(model(more={"extra": object}, extra=None))
    zoom = cls(None, value)
    lens = zj.ZoomLens(zoom, jnp.zeros(2), jnp.array([20.0, 80.0]), (640, 480))
    with pytest.raises(TypeError, match=message):
        lens.save(tmp_path / "lens.json")
    assert not list(tmp_path.iterdir())


def test_fields_keep_their_kind(registry, tmp_path):
    cls = zj.models.register_model(model(more={"extra": object}, extra=None))
    for value in (jnp.arange(3), jnp.array([True, False]), jnp.array([0.5]), None):
        lens = zj.ZoomLens(cls(None, value), jnp.zeros(2), jnp.array([20.0, 80.0]), (640, 480))
        lens.save(tmp_path / "lens.json")
        assert eqx.tree_equal(zj.load_lens(tmp_path / "lens.json").zoom, lens.zoom)
