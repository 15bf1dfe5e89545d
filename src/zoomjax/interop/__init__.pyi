# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .base import Format as Format
from .base import Report as Report
from .registry import Reading as Reading
from .registry import formats as formats
from .registry import read as read
from .registry import write as write
