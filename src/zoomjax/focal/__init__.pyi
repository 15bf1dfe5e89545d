# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .board import focal_from_board as focal_from_board
from .estimate import FocalEstimate as FocalEstimate
from .pitch import PITCH_LINES as PITCH_LINES
from .pitch import focal_from_pitch as focal_from_pitch
from .pitch import name_pitch_lines as name_pitch_lines
from .plane import focal_from_lines as focal_from_lines
from .plane import focal_from_planes as focal_from_planes
