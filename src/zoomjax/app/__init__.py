"""What people run: the command line, calibrations from end to end, their results, reports and plots."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
