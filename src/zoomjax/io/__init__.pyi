# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .equipment import Equipment as Equipment
from .equipment import read_equipment as read_equipment
from .exif import exif_focal as exif_focal
from .exif import exif_with_focal as exif_with_focal
from .focal_table import FocalTable as FocalTable
from .focal_table import read_focal_table as read_focal_table
from .focal_track import FocalTrack as FocalTrack
from .focal_track import read_focal_track as read_focal_track
from .local_copies import local_copies as local_copies
from .photo import read_photo as read_photo
from .text_table import TextTable as TextTable
from .text_table import read_text_table as read_text_table
from .video_reader import decode_video as decode_video
