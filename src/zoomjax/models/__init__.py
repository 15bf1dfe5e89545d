"""Distortion and zoom models, lenses, their files and their certificates of invertibility."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
