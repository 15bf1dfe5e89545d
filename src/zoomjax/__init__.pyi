# The public names, one place: read by type checkers, and by lazy_loader at run time.

from . import correct as correct
from . import detect as detect
from . import fit as fit
from . import focal as focal
from . import interop as interop
from . import io as io
from . import lines as lines
from . import models as models
from . import scenes as scenes
from . import torch as torch
from . import tracks as tracks
from . import trust as trust
from .app import plot as plot
from .correct import Framing as Framing
from .correct import undistort_image as undistort_image
from .correct import undistort_photo as undistort_photo
from .correct import undistort_video as undistort_video
from .correct import warp_image as warp_image
from .detect import EdgeDetector as EdgeDetector
from .fit import RESULTS as RESULTS
from .fit import FrameFits as FrameFits
from .fit import ZoomFit as ZoomFit
from .fit import cache_compiled as cache_compiled
from .fit import fit_frames as fit_frames
from .fit import fit_robust as fit_robust
from .fit import fit_zoom as fit_zoom
from .fit import frame_rms as frame_rms
from .lines import Lines as Lines
from .lines import compress as compress
from .lines import load_lines as load_lines
from .models import Camera as Camera
from .models import Distortion as Distortion
from .models import PolynomialZoom as PolynomialZoom
from .models import SmoothZoom as SmoothZoom
from .models import ZoomLens as ZoomLens
from .models import camera as camera
from .models import load_lens as load_lens
from .trust import displacement_band as displacement_band
from .trust import displacement_std as displacement_std
from .trust import select_model as select_model
from .trust import suggest_next as suggest_next

__version__: str
