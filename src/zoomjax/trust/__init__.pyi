# The public names of this room: read by type checkers, and by lazy_loader at run time.

from .assessment import Assessment as Assessment
from .assessment import Finding as Finding
from .assessment import assess as assess
from .bands import coefficient_std as coefficient_std
from .bands import displacement_band as displacement_band
from .bands import displacement_covariance as displacement_covariance
from .bands import displacement_std as displacement_std
from .bands import std_of as std_of
from .comparison import ComparedModel as ComparedModel
from .cramer_rao_bounds import cramer_rao as cramer_rao
from .cramer_rao_bounds import displacement_bound as displacement_bound
from .cramer_rao_bounds import displacement_rms as displacement_rms
from .cross_validation import cross_validate_frames as cross_validate_frames
from .cross_validation import cross_validate_zoom as cross_validate_zoom
from .evidence import Evidence as Evidence
from .evidence import evidence as evidence
from .many_selections import select_many as select_many
from .misfit import with_misfit as with_misfit
from .next_photo import Suggestion as Suggestion
from .next_photo import suggest_next as suggest_next
from .selection import Selection as Selection
from .selection import select_model as select_model
from .vanishing import VanishingPoints as VanishingPoints
from .vanishing import vanishing_points as vanishing_points
