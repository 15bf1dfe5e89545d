"""The public names: they exist, say what they do, and are the ones agreed on."""

import ast
import importlib
import importlib.metadata
import inspect
import itertools
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest

import zoomjax as zj

from ._public import DOORS, FUNCTIONS, PUBLIC, ROOMS

HEADINGS = ("Args:", "Attributes:", "Returns:", "Example:")

AGREED = {
    *("Lines", "load_lines", "compress", "fit_zoom", "fit_frames", "frame_rms"),
    *("PolynomialZoom", "ZoomLens", "load_lens", "Distortion"),
}
MEMBERS = {
    "Lines": "from_ragged to_ragged save points mask frame focal image_size",
    "ZoomLens": "save zoom centre image_size",
    "Distortion": "undistort distort coefficients pixel_coefficients centre",
    "Camera": "rays project lens principal pixel_pitch",
    "ZoomFit": "lens rms frame_rms covariance result",
    "FrameFits": "coefficients rms frame_rms",
}


def test_the_agreed_names_are_public():
    assert set(zj.__all__) >= AGREED


@pytest.mark.parametrize(("name", "members"), MEMBERS.items())
def test_the_agreed_members_exist(name, members):
    cls = getattr(zj, name)
    fields = {field for base in cls.__mro__ for field in getattr(base, "__annotations__", {})}
    assert set(members.split()) <= fields | set(dir(cls))


def test_the_package_lists_what_every_user_needs_and_no_more():
    assert len(zj.__all__) <= 30
    assert set(zj.__all__) <= set(dir(zj))
    assert all(getattr(zj, name) is not None for name in zj.__all__)


def test_a_name_has_one_home():
    names = [name.partition(".")[2] for name in PUBLIC]
    assert len(names) == len(set(names))
    assert set(zj.__all__) <= set(names)


@pytest.mark.parametrize("name", PUBLIC)
def test_public_name_is_documented(name):
    text = inspect.getdoc(PUBLIC[name])
    assert text, f"{name} has no docstring"
    summary, _, rest = text.partition("\n\n")
    assert summary.rstrip().endswith((".", ":"))
    assert not rest or any(heading in rest for heading in HEADINGS) or rest.rstrip().endswith(".")


@pytest.mark.parametrize("name", PUBLIC)
def test_public_methods_are_documented(name):
    thing = PUBLIC[name]
    if inspect.isclass(thing):
        own = {key: value for key, value in vars(thing).items() if not key.startswith("_")}
        undocumented = [key for key, value in own.items() if callable(value) and not inspect.getdoc(value)]
        assert not undocumented


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_take_one_or_two_things_by_position(name):
    thing = FUNCTIONS[name]
    if inspect.isfunction(thing):
        kinds = [parameter.kind for parameter in inspect.signature(thing).parameters.values()]
        assert kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD) <= 2


def test_results_are_sentences_to_act_on():
    for result in (zj.RESULTS.undetermined, zj.RESULTS.folded, zj.RESULTS.constrained):
        assert zj.RESULTS[result].endswith("the number of terms.")


@pytest.mark.parametrize("missing", ["av", "matplotlib"])
def test_without_an_extra_all_names_but_its_own_are_there(missing):
    """In a process that cannot import it, as where it is not installed."""
    code = f"""
import sys
sys.modules[{missing!r}] = None
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *more: None if name == {missing!r} else find(name, *more)
import pydoc
import zoomjax
pydoc.render_doc(zoomjax)
from zoomjax import *
assert set(zoomjax.__all__) <= set(globals()), "names are missing"
assert not {{"scenes", "fit", "plot"}} & set(globals()), "modules are no part of it"
try:
    undistort_video(sys.executable, "out.mp4", lens=zoomjax.scenes.nikkor_18_200(), focal=35.0)
except ModuleNotFoundError as error:
    print(error)
except ValueError as error:
    print("decoder asked")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    expected = 'Video needs PyAV: pip install "zoomjax[app]"' if missing == "av" else "decoder asked"
    assert done.stdout.strip().splitlines()[-1] == expected


def test_modules_are_reached_as_attributes():
    assert zj.scenes.nikkor_18_200().focal_unit == "mm"
    assert callable(zj.plot.plot_model)
    assert zj.camera.Camera is zj.Camera is zj.models.Camera
    assert {*ROOMS, "camera", "plot", "__version__"} <= set(dir(zj))
    assert not {*ROOMS, "camera", "plot", "torch"} & set(zj.__all__)


@pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)
def test_every_name_of_a_room_is_there(door):
    assert door.__doc__
    assert door.__all__
    assert all(hasattr(door, name) for name in door.__all__)
    assert set(door.__all__) <= set(dir(door))


def test_a_room_is_imported_without_what_is_in_it():
    code = "import sys, zoomjax.app, zoomjax.fit, zoomjax.models; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_version_is_that_of_the_package():
    assert zj.__version__ == importlib.metadata.version("zoomjax")


def test_python_m_is_the_command_line():
    done = subprocess.run(
        [sys.executable, "-m", "zoomjax", "--version"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, f"zoomjax {zj.__version__}\n"), done.stderr


def test_unknown_name_raises():
    with pytest.raises(AttributeError):
        zj.nonsense  # noqa: B018


@pytest.mark.slow
def test_the_design_in_ten_lines(noisy, tmp_path):
    """The lines that the design promises, as a user would write them."""
    lines = zj.Lines.from_ragged(
        noisy.to_ragged(), noisy.frame, noisy.focal, image_size=noisy.image_size, focal_unit="mm"
    )
    lines.save(tmp_path / "lines.npz")
    small = zj.compress(zj.load_lines(tmp_path / "lines.npz"), terms=2)
    fit = zj.fit_zoom(small)
    each = zj.fit_frames(small, terms=2)
    assert each.coefficients.shape == (4, 2)
    fit.lens.save(tmp_path / "lens.json")
    d = zj.load_lens(tmp_path / "lens.json")(35.0)
    points = jnp.array([[0.0, 0.0], [4287.0, 2847.0]])
    assert jnp.allclose(d.distort(d.undistort(points)), points, rtol=0, atol=1e-9)
    assert (zj.frame_rms(lines, fit.lens) < zj.frame_rms(lines, None)).all()


SECTIONS = ("Args:", "Returns:", "Raises:", "Warns:", "Attributes:")


@pytest.mark.parametrize("path", sorted(Path(zj.__file__).parent.rglob("*.py")), ids=lambda path: path.stem)
def test_sections_of_docstrings_hold_what_is_under_them(path):
    """The documentation's pages would show a head, and its content as running text."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module) and (
            doc := ast.get_docstring(node)
        ):
            lines = doc.splitlines()
            for head, below in itertools.pairwise(lines):
                if head.strip() in SECTIONS:
                    assert not head.startswith(" "), (
                        f"{path.name}: {head.strip()} of {getattr(node, 'name', '')}"
                    )
                    assert below.startswith("    "), (
                        f"{path.name}: below {head} of {getattr(node, 'name', '')}"
                    )
