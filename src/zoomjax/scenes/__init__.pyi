# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .board import StripedBoard as StripedBoard
from .board import board_lines as board_lines
from .board import board_photo as board_photo
from .board import focal_sweep as focal_sweep
from .board import nikkor_18_200 as nikkor_18_200
from .board import with_noise as with_noise
from .broadcast import broadcast_lines as broadcast_lines
from .broadcast import broadcast_zoom as broadcast_zoom
from .clip import MotionClip as MotionClip
from .clip import leaves as leaves
from .clip import motion_clip as motion_clip
from .motion import MotionScene as MotionScene
from .motion import motion_lines as motion_lines
from .motion import motion_tracks as motion_tracks
from .motion import pan_and_zoom as pan_and_zoom
