"""The fits of a calibration: which lines, centre and model, and then the frames and the zoom lens."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..fit.centre import fit_centre
from ..fit.frames import fit_frames
from ..fit.result import FrameFits, ZoomFit
from ..fit.robust import reweighted
from ..fit.zoom import CentreChoice as WantedCentre
from ..fit.zoom import about_centre, fit_zoom
from ..lines.compressed import CompressedLines, compress
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines
from ..trust.centre_choice import CentreChoice, choose_centre
from ..trust.selection import Candidate, Selection
from .model_choice import WantedModel


class Used(NamedTuple):
    """What the fits of a calibration are made from.

    Attributes:
        lines: with their weights, about the centre of the lens.
        model: the zoom model, not fitted.
        centre: how the centre was found; None where it was given.
        selection: how the model was chosen; None where it was given.
    """

    lines: CompressedLines
    model: Candidate
    centre: CentreChoice | None
    selection: Selection | None


def fitted(
    lines: Lines,
    model: WantedModel,
    centre: WantedCentre | None,
    *,
    robust: bool,
    stage: Callable[[str], None],
) -> tuple[ZoomFit, FrameFits, Used]:
    """The zoom lens, the separate fits of the frames, and what they are made from; see `calibrate`."""
    base = model.base(lines.focal)
    base.zoom.prepare(lines.focal, base.terms)  # raises if there are too few focal lengths, before any work
    stage("Compressing the lines")
    held = _compressed(lines, centre, model.most_terms(lines))
    small = held.about(held.centre)
    if robust:
        stage("Rejecting lines that are not straight")
        small = reweighted(small, base.zoom, base.terms)[0]
        held = held.weighted(np.asarray(small.weight))
    choice = selection = None
    if isinstance(held, AnyCentreLines):
        stage("Fitting the centre of distortion")
        choice = choose_centre(held, zoom=base.zoom, terms=base.terms)
        small = held.about(choice.found.fit.lens.centre) if choice.better else small
    if model.automatic:
        stage("Choosing the model")
        selection = model.choose(small)
        base = selection.chosen
    stage("Fitting each frame separately")
    each = fit_frames(small, terms=base.terms, throw=False)
    stage("Fitting the zoom model")
    if isinstance(held, AnyCentreLines) and choice is not None and choice.better:
        zoom = fit_centre(held, zoom=base.zoom, terms=base.terms).fit
        small = held.about(zoom.lens.centre)
    else:
        zoom = fit_zoom(small, zoom=base.zoom, terms=base.terms)
    return zoom, each, Used(small, base, choice, selection)


def _compressed(lines: Lines, centre: WantedCentre | None, terms: int) -> CompressedLines | AnyCentreLines:
    """The lines in the widest numbers, compressed about their centre, or for any if it is to be fitted."""
    widest = jnp.result_type(float)
    data = jax.tree.map(
        lambda a: jnp.asarray(a, widest) if jnp.issubdtype(a.dtype, jnp.floating) else a, lines
    )
    if not (isinstance(centre, str) and centre == "fit"):
        return compress(about_centre(data, centre), terms)
    held = compress_any_centre(data, terms)
    if held.weight is not None:
        return held
    return held.weighted(np.ones(held.frame.shape))  # as where some are left out: one compiled program
