# The public names of this room: read by type checkers, and by lazy_loader at run time.

from . import plot as plot
from .calibrating import calibrate as calibrate
from .calibration import Calibration as Calibration
from .image_calibration import ImageCalibration as ImageCalibration
from .image_calibration import calibrate_images as calibrate_images
from .image_job import ImageJob as ImageJob
