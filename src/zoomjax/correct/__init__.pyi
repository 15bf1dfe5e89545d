# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .framing import Framing as Framing
from .framing import frame_output as frame_output
from .image import undistort_image as undistort_image
from .photo import undistort_photo as undistort_photo
from .video import CorrectedVideo as CorrectedVideo
from .video import undistort_video as undistort_video
from .warp import warp_image as warp_image
