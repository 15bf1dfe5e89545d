# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .base import Format as Format
from .base import Report as Report
from .database import LensTable as LensTable
from .database import find_lenses as find_lenses
from .database import lens_names as lens_names
from .library import library_lens as library_lens
from .matching import LensMatch as LensMatch
from .matching import match_lens as match_lens
from .registry import Reading as Reading
from .registry import formats as formats
from .registry import read as read
from .registry import write as write
