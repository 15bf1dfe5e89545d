# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .database import LensTable as LensTable
from .database import find as find
from .database import names as names
from .library import load as load
from .matching import Match as Match
from .matching import match as match
