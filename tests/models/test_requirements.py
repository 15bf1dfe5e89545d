"""One sentence, from one place, for models that a function does not serve."""

import ast
from pathlib import Path

import pytest

import zoomjax as zj
from zoomjax.models import requirements

ROOT = Path(zj.__file__).parent


@pytest.mark.parametrize("use", requirements.REQUIREMENTS)
def test_the_sentence_names_the_use_and_what_was_given(use):
    wrong = {
        "zoom": zj.models.FocusSplineZoom(),
        "distortion_model": zj.models.BrownConrady(),
        "shift": zj.PolynomialZoom(1),
    }
    right = {"zoom": zj.PolynomialZoom(), "distortion_model": zj.models.Division(), "shift": None}
    for name in requirements.REQUIREMENTS[use]:
        given = "a centre that moves" if name == "shift" else type(wrong[name]).__name__
        with pytest.raises(ValueError, match=rf"^{use} needs an? .*, and it was given .*{given}"):
            requirements.check(use, **{name: wrong[name]})
        requirements.check(use, **{name: right[name]})


def calls():
    """The uses that the library checks, by the modules that do."""
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            named = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args
            if named and node.func.id in ("check", "refusal") and isinstance(node.args[0], ast.Constant):
                yield node.args[0].value


def test_every_entry_is_used_and_every_use_has_an_entry():
    assert set(calls()) == set(requirements.REQUIREMENTS)


def test_no_other_place_refuses_a_kind_of_model():
    """No `raise` right below a question for a model's class; constructors' own arguments aside."""
    kinds = {"AbstractRadial", "RadialPolynomial", "AbstractFocusZoom", "BrownConrady", "Division"}
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.If) and any(isinstance(line, ast.Raise) for line in node.body):
                asked = {name.id for name in ast.walk(node.test) if isinstance(name, ast.Name)}
                found += [path.relative_to(ROOT).as_posix()] * bool(asked & kinds)
    assert set(found) <= {"models/lens.py"}, found  # at_focus of a lens without one: a TypeError
