"""The package is twelve rooms on a private base, and imports go one way: from a room to those below."""

import ast
from pathlib import Path

import pytest

import zoomjax

ROOMS = (
    "app",
    "trust",
    "fit",
    "scenes",
    "correct",
    "lines",
    "tracks",
    "detect",
    "focal",
    "interop",
    "models",
    "io",
    "_core",
)
"""From the top down: a room imports from rooms after it in this list alone."""

TOP = {"torch": {"correct", "models", "_core"}, "__main__": {"app"}}
"""Modules beside the rooms, and what they import from."""

LIBRARIES = {
    "app": {"matplotlib", "typer", "rich", "cv2", "jinja2", "distributed"},
    "correct": {"cv2"},
    "detect": {"cv2"},
    "io": {"cv2", "av", "PIL", "pillow_heif", "rawpy", "tifffile"},
    "interop": {"OpenEXR", "cv2", "lensfunpy", "yaml"},
    "torch": {"torch"},
    "tracks": {"cv2"},
}
"""Libraries of images, plots, terminals and video, and where they may be imported."""

ALL_LIBRARIES = set().union(*LIBRARIES.values())

MOST_LINES = 400

ROOT = Path(zoomjax.__file__).parent
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): path
    for path in sorted(ROOT.rglob("*.py"))
    if path != ROOT / "__init__.py"
}

every_module = pytest.mark.parametrize("name", FILES)


def room(name):
    return name.split(".")[0]


def imports(name):
    """Absolute names of what a module imports, anywhere in its code."""
    package = ["zoomjax", *FILES[name].relative_to(ROOT).parts[:-1]]
    for node in ast.walk(ast.parse(FILES[name].read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *filter(None, [node.module])])
            modules = [f"{origin}.{alias.name}" for alias in node.names]
            # from . import x: a module
            yield from modules if is_module(modules[0]) else [origin]


def is_module(absolute):
    return absolute.removeprefix("zoomjax.") in FILES


def own(name):
    """What a module imports of the package: modules, each by its path from the package on."""
    return [other.removeprefix("zoomjax.") for other in imports(name) if other.startswith("zoomjax.")]


def circle(name, arrows, above=()):
    """The modules of a circle that can be reached from a module, or nothing."""
    if name in above:
        return [*above[above.index(name) :], name]
    return next(filter(None, (circle(other, arrows, (*above, name)) for other in arrows.pop(name, ()))), [])


def test_the_rooms_are_these():
    folders = {path.name for path in ROOT.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders == set(ROOMS)
    assert {name for name in FILES if "." not in name} == set(TOP)


@every_module
def test_module_imports_from_rooms_below_only(name):
    below = TOP[name] if name in TOP else set(ROOMS[ROOMS.index(room(name)) + 1 :])
    assert {room(other) for other in own(name)} <= below | {room(name)}


@every_module
def test_module_imports_modules_and_no_doors(name):
    assert not [other for other in own(name) if other not in FILES or other in ROOMS]


@every_module
def test_module_leaves_alone_what_is_private_to_another_room(name):
    others = [other.split(".")[1:] for other in own(name) if room(other) != room(name)]
    assert not [path for path in others if any(part.startswith("_") for part in path)]


def test_no_modules_import_each_other_in_a_circle():
    arrows = {name: own(name) for name in FILES}
    assert not [found for name in FILES if (found := circle(name, dict(arrows)))]


@every_module
def test_module_imports_no_application_library_but_its_rooms(name):
    used = {other.split(".")[0] for other in imports(name)} & ALL_LIBRARIES
    assert used <= LIBRARIES.get(room(name), set())


@every_module
def test_module_does_not_import_the_package_from_within(name):
    assert "zoomjax" not in set(imports(name))


@every_module
def test_module_is_not_too_long(name):
    assert len(FILES[name].read_text().splitlines()) <= MOST_LINES
