"""zoomjax: one continuous, differentiable distortion model for a zoom lens.

The public names are listed, once, in ``__init__.pyi``. They are imported when first used, so that
``zoomjax --help`` does not wait for JAX. So are the rooms of the package, from ``zoomjax.models`` to
``zoomjax.plot``, which are not part of ``from zoomjax import *``.
"""

import importlib.util
from typing import Any

import lazy_loader

_getattr, _, _names = lazy_loader.attach_stub(__name__, __file__)

_ROOMS = (
    "models",
    "focal",
    "io",
    "interop",
    "detect",
    "lines",
    "tracks",
    "correct",
    "scenes",
    "fit",
    "trust",
)

_MODULES = {**dict.fromkeys((*_ROOMS, "camera"), "numpy"), "plot": "matplotlib", "torch": "torch"}
"""Modules that are reached as attributes, and what each of them needs."""

__all__ = [name for name in _names if name not in _MODULES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        import importlib.metadata

        return importlib.metadata.version(__name__)
    return _getattr(name)


def __dir__() -> list[str]:
    # `help` and completion take what is listed: not what is not installed.
    modules = [name for name, needed in _MODULES.items() if importlib.util.find_spec(needed)]
    return sorted([*__all__, *modules, "__version__"])
