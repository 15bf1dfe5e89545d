"""Imports go one way, and only the outer layers know images, plots, terminals and video."""

import ast
from pathlib import Path

import pytest

import zoomjax

# From the inside out: a module may import from layers before its own. Packages count as one module.
LAYERS = (
    {"_types", "_files", "_text", "_checks", "_fields", "_arguments", "_linear", "_bernstein", "_interior"},
    {"_arrays"},
    {"_roots"},
    {"_results", "families", "focal", "_splines"},
    {"radial"},
    {"inverse", "pitch"},
    {"zoom"},
    {"rivals", "smooth"},
    {"focus"},
    {"models"},
    {"lines"},
    {"energy"},
    {"lens"},
    {"certificate", "bounds", "camera", "sizes", "training"},
    {"framing"},
    {"positions", "warp"},
    {"torch"},
    {"_solver", "compression"},
    {"any_centre", "image_metric"},
    {"family_lines"},
    {"concatenation"},
    {"algebraic"},
    {"uncertainty"},
    {"fit"},
    {"bands", "robust", "centre", "focal_error", "held_out"},
    {"design", "blunders", "selection"},
    {"synthetic", "broadcast", "metrics", "io"},
    {"plot"},
    {"calibration"},
    {"reproduce"},
    {"vision"},
    {"report"},
    {"cli"},
    {"__main__"},
)
OUTER = {
    "plot": {"matplotlib"},
    "vision": {"cv2", "av"},
    "torch": {"torch"},
    "report": {"matplotlib"},
    "reproduce": {"matplotlib"},
    "cli": {"typer", "rich"},
}
HEAVY = set().union(*OUTER.values())

ROOT = Path(zoomjax.__file__).parent
LEVEL = {module: level for level, layer in enumerate(LAYERS) for module in layer}
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): path
    for path in sorted(ROOT.rglob("*.py"))
    if path != ROOT / "__init__.py"
}

every_module = pytest.mark.parametrize("name", FILES)


def top(name):
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
            if origin == "zoomjax":  # from . import x: the names are modules
                yield from (f"zoomjax.{alias.name}" for alias in node.names)
            else:
                yield origin


@every_module
def test_module_has_its_layer(name):
    assert top(name) in LEVEL, f"add {top(name)} to LAYERS, as far in as its imports allow"


@every_module
def test_module_imports_from_inner_layers_only(name):
    level = LEVEL[top(name)]
    own = [other.split(".")[1] for other in imports(name) if other.startswith("zoomjax.")]
    outward = {other for other in own if other != top(name) and LEVEL.get(other, len(LAYERS)) >= level}
    assert not outward


@every_module
def test_module_imports_no_application_library_but_its_own(name):
    used = {other.split(".")[0] for other in imports(name)} & HEAVY
    assert used <= OUTER.get(top(name), set())


@every_module
def test_module_does_not_import_the_package_from_within(name):
    assert "zoomjax" not in set(imports(name))


def test_layers_name_each_module_once():
    assert len(LEVEL) == sum(len(layer) for layer in LAYERS)
