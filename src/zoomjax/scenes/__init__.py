"""Synthetic scenes with exact truth: the paper's striped board, and a broadcast of football."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
