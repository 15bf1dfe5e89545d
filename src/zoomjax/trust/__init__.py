"""How far a fit can be trusted: bands, bounds, cross-validation, the choice of a model, the next photo."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
