# The public names, one place: read by type checkers, and by lazy_loader at run time.

from .algebraic import algebraic_frames as algebraic_frames
from .algebraic import algebraic_zoom as algebraic_zoom
from .compression import CompressedLines as CompressedLines
from .compression import compress as compress
from .compression import merge as merge
from .energy import frame_energy as frame_energy
from .energy import global_energy as global_energy
from .energy import residuals as residuals
from .fit import RESULTS as RESULTS
from .fit import FrameFits as FrameFits
from .fit import ZoomFit as ZoomFit
from .fit import fit_frames as fit_frames
from .fit import fit_zoom as fit_zoom
from .fit import frame_rms as frame_rms
from .io.lines_csv import read_focal_csv as read_focal_csv
from .io.lines_csv import read_lines_csv as read_lines_csv
from .io.lines_csv import write_lines_csv as write_lines_csv
from .lens import ZoomLens as ZoomLens
from .lens import load_lens as load_lens
from .lines import AbstractLines as AbstractLines
from .lines import Lines as Lines
from .lines import load_lines as load_lines
from .radial import Distortion as Distortion
from .zoom import AbstractLinearZoom as AbstractLinearZoom
from .zoom import AbstractZoom as AbstractZoom
from .zoom import PolynomialZoom as PolynomialZoom
