# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .again import find_again as find_again
from .csv import read_tracks_csv as read_tracks_csv
from .csv import write_tracks_csv as write_tracks_csv
from .key_frames import KeyFrames as KeyFrames
from .npz import load_tracks as load_tracks
from .tracks import Tracks as Tracks
from .video import track_frames as track_frames
from .video import track_video as track_video
