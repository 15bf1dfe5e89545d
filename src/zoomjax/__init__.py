"""zoomjax: one continuous, differentiable distortion model for a zoom lens.

The public names are listed, once, in ``__init__.pyi``. They are imported when first used, so that
``zoomjax --help`` does not wait for JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
