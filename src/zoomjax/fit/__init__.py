"""Fits: energies of lines under a model, their minimisation, and the straightness of corrected lines."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
