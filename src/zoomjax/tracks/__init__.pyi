# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .tracks import Tracks as Tracks
