# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .base import AbstractDetector as AbstractDetector
from .batch import Detection as Detection
from .batch import detect as detect
from .edges import EdgeDetector as EdgeDetector
from .edges import Edges as Edges
from .grid import GridDetector as GridDetector
from .grid import find_checkerboard as find_checkerboard
from .grid import find_dots as find_dots
from .pitch import PitchDetector as PitchDetector
from .sources import Source as Source
from .sources import find_photos as find_photos
from .sources import video_frames as video_frames
