# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .framing import Framing as Framing
from .framing import frame_output as frame_output
from .image import undistort_image as undistort_image
from .photo import redistort_photo as redistort_photo
from .photo import undistort_photo as undistort_photo
from .redistort import redistort_image as redistort_image
from .video import CorrectedVideo as CorrectedVideo
from .video import redistort_video as redistort_video
from .video import undistort_video as undistort_video
from .warp import warp_image as warp_image
