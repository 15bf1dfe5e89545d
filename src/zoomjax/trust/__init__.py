"""Reliability of a fit: bands, Cramér–Rao bounds, cross-validation, model selection and the next photo."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
