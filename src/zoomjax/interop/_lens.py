"""A zoom lens from what a file holds: coefficients at each focal length, and a zoom model through them.

Tools that map corrected to distorted points are inverted by a fit: their pairs of points are fitted by our
polynomial, which maps the other way. A zoom model that is linear in its parameters a is then one linear
least squares problem for all focal lengths m,

    sum_m mean_p |x̂_mp - x_mp - sum_i x_mp t_mp^i (phi_m . a_i)|²  +  the zoom model's prior  ->  min,

the positions of all points counting alike, as in the energy of `fit_zoom` with its prior.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from ..models.brown_conrady import BrownConrady
from ..models.distortion_model import AbstractDistortionModel
from ..models.division import Division
from ..models.lens import ZoomLens
from ..models.model import Model
from ..models.polynomial import RadialPolynomial
from ..models.smooth import SmoothZoom
from ..models.tables import TableZoom
from ..models.zoom import (
    AbstractLinearZoom,
    AbstractPriorZoom,
    AbstractZoom,
    PolynomialZoom,
    with_parameters,
)
from ._centre import centres_and_model
from ._forms import Form
from ._pinhole import pitch_of
from ._samples import Pairs, distortions
from ._seen import Seen, against, distance, inside, once, seen_of
from .base import TOLERANCE, Contents, Node, Sampled, possible
from .radial_table import RadialTable, zoom_of_table

_MUCH = 0.5
"""px at the nodes from which a user is told of tables."""

_TERMS, _KEPT = 2, AbstractDistortionModel.most_terms
"""Coefficients of a `SmoothZoom`, whose prior is for two, and of models that keep a file's values."""

_MOVED = 0.05
"""px by which the file's centres must differ for the lens's centre to move."""

_NOT_SQUARE = 1e-6
"""Share by which pixels must differ from squares to be told of."""

_SHARES = tuple(tuple(i / parts for i in range(1, parts)) for parts in (1, 2, 4, 8, 16))
"""Where a table has entries of the tool's own interpolation, in each interval, until it follows that."""

_CHECKED = (0.2, 0.45, 0.8)
"""Where that is looked at."""

_PASSES, _SAME_SCALE = 5, 1e-7
"""Fits at most, until the scale of corrected points changes by so little."""


class UnsuitedError(ValueError):
    """The zoom model that was asked for does not suit the contents of a file that is sound."""


@dataclasses.dataclass(frozen=True)
class Made:
    """A lens of a file's contents.

    Attributes:
        lens: the lens.
        focal: focal lengths of the nodes, as the lens has them.
        at_nodes: its greatest error at the nodes, px (see `Report`).
        between: its greatest error between them; None where the tool does not interpolate.
        notes: what the user should know.
    """

    lens: ZoomLens
    focal: tuple[float, ...]
    at_nodes: float
    between: float | None
    notes: tuple[str, ...]


def lens_of(
    contents: Contents,
    zoom: AbstractLinearZoom | None,
    terms: int | None,
    distortion_model: AbstractDistortionModel | None = None,
) -> Made:
    """The zoom lens of a file's contents.

    Args:
        contents: of the file.
        zoom: the zoom model; None for the default, which depends on the contents.
        terms: number of radial coefficients; None for two of a `SmoothZoom`, else for those of the file
            where its formula is ours, or four.
        distortion_model: None for that which holds the file's values, or is nearest to them.
    """
    if terms is None and distortion_model is None and (zoom is None or _keeps_all(zoom)):
        made = None if contents.table is None else _of_table(contents, contents.table, zoom is None)
        if made is not None:
            return made
    nodes, others = once(contents.nodes)
    size, notes, given = contents.image_size, [], distortion_model
    if sampled := [node for node in nodes if isinstance(node, Sampled)]:
        centres, distortion_model = centres_and_model(sampled, size, distortion_model)
        at = {node.focal: centre for node, centre in zip(sampled, centres, strict=True)}
        nodes = [dataclasses.replace(node, centre=at[node.focal]) for node in nodes]
        others = [dataclasses.replace(node, centre=at[node.focal]) for node in others]
    own, exact = _distortion_model(nodes, terms)
    if distortion_model is not None and type(distortion_model) is not type(own):
        own, exact = distortion_model, False
    chosen = zoom is None
    if zoom is None:
        zoom = _default_zoom(own, len(nodes), terms)
    count = terms or (_TERMS if isinstance(zoom, SmoothZoom) else _terms(nodes, exact))
    model = _unfitted(zoom, count, own)
    seen = [seen_of(node, size) for node in nodes]
    if short := [f"{each.node.focal:g}" for each in seen if not each.whole]:
        notes.append(
            f"The file's distortion turns back before the border of the image at {', '.join(short)} "
            f"{contents.focal_unit}: the lens is not validated beyond."
        )
    contents, seen = _with_rays(contents, seen, model)
    notes = [*contents.notes, *notes]
    lens, at_nodes, between, note = _following(contents, seen, model)
    if not math.isfinite(at_nodes):
        if chosen and isinstance(zoom, SmoothZoom):
            return lens_of(contents, TableZoom(), terms, given)
        raise ValueError(
            f"the lens that is nearest to it folds over within the image with a {type(zoom).__name__} and "
            f"the distortion model {type(own).__name__}"
        )
    stretched = [abs(n.stretch[0] / n.stretch[1] - 1) for n in nodes if isinstance(n, Node)]
    if (most := max(stretched, default=0.0)) > _NOT_SQUARE:
        notes.append(f"The file's pixels are up to {100 * most:.2g} % from square: the lens's are square.")
    if at_nodes > _MUCH and len(nodes) > 1 and not isinstance(zoom, TableZoom):
        notes.append(
            f"The zoom model smooths the file's values, by up to {at_nodes:.2g} px: a table, TableZoom(), "
            "keeps them."
        )
    elif between is not None and between > _MUCH and not isinstance(zoom, TableZoom):
        notes.append(
            f"Between the file's focal lengths the lens is smooth, up to {between:.2g} px from the tool's "
            "own interpolation: a table, TableZoom(), keeps to that."
        )
    if others:
        far = _error(lens, [seen_of(node, size) for node in others])
        at_nodes = max(at_nodes, far)
        notes.append(
            f"Entries of one focal length are not alike, as at {others[0].focal:g} {contents.focal_unit}: "
            f"the lens is that of the first of each, up to {far:.2g} px from the others."
        )
    focal = tuple(float(each.node.focal) for each in seen)
    return Made(lens, focal, at_nodes, between, (*notes, *note))


def _unfitted(zoom: AbstractLinearZoom, terms: int, distortion_model: AbstractDistortionModel) -> Model:
    try:
        return Model(zoom, terms, distortion_model)
    except ValueError as error:
        raise UnsuitedError(str(error)) from error


def _with_rays(contents: Contents, seen: list[Seen], model: Model) -> tuple[Contents, list[Seen]]:
    """What files of fields of view say, in the scale of corrected points that a lens through them has.

    The fit chooses this scale, and focal lengths follow it, so that rays are kept. Errors are then those of
    rays. Where focal lengths are labels in mm, the pixel pitch follows, and the scale stays free.
    """
    if any(each.focal_px is None for each in seen):
        return contents, seen
    in_px = contents.focal_unit == "px"
    for _ in range(_PASSES):
        lens, _notes = _lens(contents, seen, model)
        each = distortions(lens, np.array([one.node.focal for one in seen]))
        by = np.array([against(*pair, lens.scale)[3] for pair in zip(each, seen, strict=True)])
        if not (np.isfinite(by) & (by > 0)).all():
            break
        seen = [one.magnified(float(b), focal=in_px) for one, b in zip(seen, by, strict=True)]
        if np.abs(by - 1).max() < _SAME_SCALE:
            break
    if in_px:
        seen = [dataclasses.replace(one, any_scale=False) for one in seen]
        return contents, sorted(seen, key=lambda one: one.node.focal)
    pitch, notes = pitch_of([one.node.focal for one in seen], [one.focal_px or math.nan for one in seen])
    contents = dataclasses.replace(contents, pixel_pitch=pitch, notes=(*contents.notes, *notes))
    return possible(contents), seen


def _following(
    contents: Contents, seen: list[Seen], model: Model
) -> tuple[ZoomLens, float, float | None, tuple[str, ...]]:
    """The lens through nodes, its errors at and between them, and notes.

    A table gets entries of the tool's own interpolation, more and more, until it follows that.
    """
    between, size = contents.between, contents.image_size
    if between is None or len(seen) == 1:
        lens, notes = _lens(contents, seen, model)
        return lens, _error(lens, seen), None, notes
    nodes = [each.node for each in seen]
    checked = inside(between, nodes, _CHECKED, size)
    levels = _SHARES if _keeps_all(model.zoom) else _SHARES[:1]
    for shares in levels:
        more = inside(between, nodes, shares, size)
        told = sorted([*seen, *more], key=lambda each: each.node.focal)
        lens, notes = _lens(contents, told, model)
        at_nodes, error = _error(lens, seen), _error(lens, checked)
        if error <= max(TOLERANCE, at_nodes) or shares is levels[-1]:
            return lens, at_nodes, error, notes
    raise AssertionError


def _keeps_all(zoom: AbstractZoom) -> bool:
    """Whether it is a table with entries wherever there are values."""
    return isinstance(zoom, TableZoom) and zoom.number is None and zoom.parameters is None


def _of_table(contents: Contents, table: RadialTable, auto: bool) -> Made | None:
    """The lens of a tool's table of radial polynomials, as in the library of lenses; None if it folds."""
    [centre] = {tuple(np.asarray(node.centre, float).tolist()) for node in contents.nodes}
    size, model = contents.image_size, "auto" if auto else "table"
    found = zoom_of_table(table, centre=np.array(centre), image_size=size, model=model)
    if found is None:
        return None
    notes = list(contents.notes)
    if found.short:
        where = ", ".join(f"{focal:g}" for focal in found.short)
        notes.append(
            f"The file's distortion turns back before the border of the image at {where} "
            f"{contents.focal_unit}: the lens is not validated beyond."
        )
    lens = ZoomLens(
        found.zoom,
        jnp.asarray(centre),
        jnp.asarray([table.focal[0], table.focal[-1]]),
        size,
        focal_unit=contents.focal_unit,
        pixel_pitch=contents.pixel_pitch,
        about=contents.about,
    )
    between = found.between if len(table.focal) > 1 else None
    return Made(lens, tuple(table.focal), found.at_nodes, between, tuple(notes))


def _lens(contents: Contents, seen: list[Seen], model: Model) -> tuple[ZoomLens, tuple[str, ...]]:
    """The lens of least squares through nodes, and what is to be said of its centre."""
    size = contents.image_size
    scale, focal = math.hypot(*size) / 2, np.array([each.node.focal for each in seen])
    own = np.array([each.node.centre for each in seen], float)
    centre, shift, notes = np.mean(own, axis=0), None, ()
    if np.ptp(own, axis=0).max() > _MOVED and len(seen) > 1:
        shift = TableZoom() if _keeps_all(model.zoom) else PolynomialZoom(1)
        shift, moved = _through(shift, focal, (own - centre) / scale)
        off = np.hypot(*(own - centre - scale * moved).T).max()
        notes = (
            f"The lens's centre moves along the zoom, as the file's do, by up to "
            f"{np.ptp(own, axis=0).max():.2g} px"
            + (f"; they scatter by up to {off:.2g} px about it." if off > _MOVED else "."),
        )
    else:
        moved = np.zeros_like(own)
    points = [each.about(centre + scale * by, scale) for each, by in zip(seen, moved, strict=True)]
    zoom = _fitted(model, focal, points, [each.any_scale for each in seen])
    lens = ZoomLens(
        zoom,
        jnp.asarray(centre),
        jnp.asarray([focal[0], focal[-1]]),
        size,
        focal_unit=contents.focal_unit,
        shift=shift,
        distortion_model=model.distortion_model,
        pixel_pitch=contents.pixel_pitch,
        about=contents.about,
    )
    return lens, notes


def _through(
    zoom: AbstractLinearZoom, focal: np.ndarray, values: np.ndarray
) -> tuple[AbstractLinearZoom, np.ndarray]:
    """A zoom model of least squares through values at focal lengths, and what it is there."""
    prepared = zoom.prepare(jnp.asarray(focal), values.shape[1])
    assert isinstance(prepared, AbstractLinearZoom)
    basis = np.asarray(jax.vmap(prepared.basis)(jnp.asarray(focal)), float)
    parameters = np.linalg.lstsq(basis, values, rcond=None)[0]
    return with_parameters(prepared, jnp.asarray(parameters)), basis @ parameters


def _distortion_model(
    nodes: list[Node | Sampled], terms: int | None
) -> tuple[AbstractDistortionModel, bool]:
    """The distortion model that holds the file's coefficients or comes near, and whether it holds them."""
    forms = {node.form for node in nodes if isinstance(node, Node)}
    form = forms.pop() if len(forms) == 1 else None
    if not isinstance(form, Form):
        return RadialPolynomial(), False
    parts = [form.split(node.theta) for node in nodes if isinstance(node, Node)]
    numerators, denominators, tangents = (any(np.any(part[i]) for part in parts) for i in range(3))
    if tangents:
        return BrownConrady(), form.corrects and not denominators and terms is None
    if form.corrects and denominators and not numerators:
        return Division(), terms is None
    return RadialPolynomial(), form.corrects and not denominators and terms is None


def _terms(nodes: list[Node | Sampled], exact: bool) -> int:
    """As many as the file has where they are ours, else as many as there may be."""
    if not exact:
        return _KEPT
    formulas = [(n.form, n.theta) for n in nodes if isinstance(n, Node)]
    used = [p for form, theta in formulas if isinstance(form, Form) for p in form.split(theta)[:2]]
    most = max([1, *(int(np.max(np.flatnonzero(part), initial=-1)) + 1 for part in used)])
    return min(most, _KEPT)


def _default_zoom(
    distortion_model: AbstractDistortionModel, number: int, terms: int | None
) -> AbstractLinearZoom:
    if number == 1:
        return PolynomialZoom(degree=0)
    if isinstance(distortion_model, RadialPolynomial) and terms in (None, _TERMS):
        return SmoothZoom()
    return TableZoom()


def _fitted(
    model: Model, focal: np.ndarray, points: list[Pairs], any_scale: list[bool]
) -> AbstractLinearZoom:
    """The zoom model with the parameters of least squares."""
    try:
        prepared = model.zoom.prepare(jnp.asarray(focal), model.num_coefficients)
    except ValueError as error:
        raise UnsuitedError(str(error)) from error
    assert isinstance(prepared, AbstractLinearZoom)
    basis = np.asarray(jax.vmap(prepared.basis)(jnp.asarray(focal)), float)  # (node, basis)
    equations = [
        _scaled_equations(model, *pair, scaled) for pair, scaled in zip(points, any_scale, strict=True)
    ]
    if _keeps_all(model.zoom):  # each node by itself
        rows = np.array([np.linalg.lstsq(*pair, rcond=None)[0] for pair in equations])
        return with_parameters(prepared, jnp.asarray(basis.T @ rows))  # a permutation
    rows, right = [], []
    for phi, (matrix, change) in zip(basis, equations, strict=True):
        share = math.sqrt(2 / len(change))  # of one point
        rows.append(np.einsum("b,rk->rbk", phi, matrix).reshape(len(matrix), -1) * share)
        right.append(change * share)
    if isinstance(prepared, AbstractPriorZoom):
        prior, towards = _prior(prepared)
        rows.append(prior)
        right.append(towards)
    a = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return with_parameters(prepared, jnp.asarray(a.reshape(basis.shape[1], -1)))


def _scaled_equations(
    model: Model, distorted: np.ndarray, corrected: np.ndarray, any_scale: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Those of `_equations`, without the unknown scale of corrected points, if they have one."""
    matrix, change = _equations(model, distorted, corrected)
    if any_scale:  # it is one more unknown, which drops out
        outwards = corrected.ravel() / np.linalg.norm(corrected)
        matrix = matrix - np.outer(outwards, outwards @ matrix)
        change = change - outwards * (outwards @ change)
    return matrix, change


def _equations(model: Model, distorted: np.ndarray, corrected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear equations for a node's coefficients in our order: matrix (row, coefficient), right side."""
    t = np.sum(distorted**2, axis=-1, keepdims=True)
    x, y = distorted.T
    divides = isinstance(model.distortion_model, Division)
    radial = corrected if divides else distorted
    columns = [radial * t ** (i + 1) for i in range(model.terms)]
    if isinstance(model.distortion_model, BrownConrady):
        t = t[:, 0]
        columns += [np.stack([2 * x * y, t + 2 * y * y], -1), np.stack([t + 2 * x * x, 2 * x * y], -1)]
    change = distorted - corrected if divides else corrected - distorted
    return np.stack([column.ravel() for column in columns], axis=-1), change.ravel()


def _prior(zoom: AbstractPriorZoom) -> tuple[np.ndarray, np.ndarray]:
    """Equations whose sum of squares is the prior's part of the energy, times the number of nodes."""
    none = jnp.zeros_like(jnp.asarray(zoom.parameters))

    def row(parameters):
        return float(zoom.error) * with_parameters(zoom, parameters).standardised()

    rows = np.asarray(jax.jacfwd(row)(none), float)
    return rows.reshape(len(rows), -1), -np.asarray(row(none), float)


def _error(lens: ZoomLens, seen: list[Seen]) -> float:
    """The greatest distance of the lens from nodes, px."""
    each = distortions(lens, np.array([one.node.focal for one in seen]))
    return max(distance(*pair, lens.scale) for pair in zip(each, seen, strict=True))
