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
from ..models.division import Division
from ..models.family import AbstractFamily
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from ..models.smooth import SmoothZoom
from ..models.tables import TableZoom
from ..models.zoom import AbstractLinearZoom, AbstractPriorZoom, PolynomialZoom, with_parameters
from ._centre import centre_and_family
from ._forms import Form
from ._samples import distortions, pairs_of
from .base import Contents, Node, Sampled

_MUCH = 0.5
"""px at the nodes from which a user is told of tables."""

_TERMS, _KEPT = 2, AbstractFamily.most_terms
"""Coefficients of a `SmoothZoom`, whose prior is for two, and of models that keep a file's values."""


class UnsuitedError(ValueError):
    """The zoom model that was asked for does not suit the contents of a file that is sound."""


Pairs = tuple[np.ndarray, np.ndarray]


def lens_of(
    contents: Contents,
    zoom: AbstractLinearZoom | None,
    terms: int | None,
    family: AbstractFamily | None = None,
) -> tuple[ZoomLens, float, tuple[str, ...]]:
    """The zoom lens of a file's contents.

    Args:
        contents: of the file.
        zoom: the zoom model; None for the default, which depends on the contents.
        terms: number of radial coefficients; None for two of a `SmoothZoom`, else for those of the file
            where its formula is ours, or four.
        family: the distortion model; None for that which holds the file's values, or is nearest to them.

    Returns:
        The lens, its greatest error at the nodes, px of the corrected image, and notes.
    """
    nodes = sorted(_averaged(contents.nodes), key=lambda node: node.focal)
    focal = np.array([node.focal for node in nodes])
    size, notes = contents.image_size, list(contents.notes)
    if sampled := [node for node in nodes if isinstance(node, Sampled)]:
        centre, family = centre_and_family(sampled, size, family)
        nodes = [dataclasses.replace(node, centre=centre) for node in nodes]
    scale, centres = math.hypot(*size) / 2, [_centre(node, size) for node in nodes]
    centre = np.mean(centres, axis=0)
    found = [_pairs(node, size) for node in nodes]
    if short := [f"{node.focal:g}" for node, (_, _, whole) in zip(nodes, found, strict=True) if not whole]:
        notes.append(
            f"The file's distortion turns back before the border of the image at {', '.join(short)} "
            f"{contents.focal_unit}: the lens is not validated beyond."
        )
    points = [
        (d + (c - centre) / scale, u + (c - centre) / scale)
        for (d, u, _), c in zip(found, centres, strict=True)
    ]
    any_scale = [isinstance(node, Node) and node.form.any_scale for node in nodes]
    own, exact = _family(nodes, terms)
    family, exact = (own, exact) if family is None or type(family) is type(own) else (family, False)
    if zoom is None:
        zoom = _default_zoom(family, len(focal), terms)
    count = terms or (_TERMS if isinstance(zoom, SmoothZoom) else _terms(nodes, exact))
    model = _fitted(zoom, focal, points, any_scale, family, count)
    spread = np.ptp(centres, axis=0).max()
    if spread > 0.5:
        notes.append(
            f"The file's centres differ by up to {spread:.2g} px: their mean is the lens's centre."
        )
    lens = ZoomLens(
        model,
        jnp.asarray(centre),
        jnp.asarray([focal[0], focal[-1]]),
        size,
        focal_unit=contents.focal_unit,
        family=family,
    )
    worst = _worst(lens, focal, points, any_scale)
    stretched = [abs(node.stretch[0] / node.stretch[1] - 1) for node in nodes if isinstance(node, Node)]
    if (most := max(stretched, default=0.0)) > 0:
        notes.append(f"The file's pixels are up to {100 * most:.2g} % from square: the lens's are square.")
    if worst > _MUCH and len(focal) > 1 and not isinstance(model, TableZoom):
        notes.append("The zoom model smooths the file's values: a table, TableZoom(), keeps them.")
    return lens, worst, tuple(notes)


def _averaged(nodes: tuple[Node | Sampled, ...]) -> list[Node | Sampled]:
    """One node for each focal length: of several, as in a track that stands still, the first."""
    return list({node.focal: node for node in reversed(nodes)}.values())


def _centre(node: Node | Sampled, size: tuple[int, int]) -> np.ndarray:
    return (np.array(size) - 1) / 2 if node.centre is None else np.asarray(node.centre, float)


def _pairs(node: Node | Sampled, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, bool]:
    if not isinstance(node, Sampled):
        return pairs_of(node, size)
    centre, scale = _centre(node, size), math.hypot(*size) / 2
    return (node.distorted - centre) / scale, (node.corrected - centre) / scale, True


def _family(nodes: list[Node | Sampled], terms: int | None) -> tuple[AbstractFamily, bool]:
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


def _default_zoom(family: AbstractFamily, number: int, terms: int | None) -> AbstractLinearZoom:
    if number == 1:
        return PolynomialZoom(degree=0)
    if isinstance(family, RadialPolynomial) and terms in (None, _TERMS):
        return SmoothZoom()
    return TableZoom()


def _fitted(
    zoom: AbstractLinearZoom,
    focal: np.ndarray,
    points: list[Pairs],
    any_scale: list[bool],
    family: AbstractFamily,
    terms: int,
) -> AbstractLinearZoom:
    """The zoom model with the parameters of least squares."""
    size = family.size(terms)
    try:
        prepared = zoom.prepare(jnp.asarray(focal), size)
    except ValueError as error:
        raise UnsuitedError(str(error)) from error
    assert isinstance(prepared, AbstractLinearZoom)
    basis = np.asarray(jax.vmap(prepared.basis)(jnp.asarray(focal)), float)  # (node, basis)
    rows, right = [], []
    for phi, (distorted, corrected), scaled in zip(basis, points, any_scale, strict=True):
        matrix, change = _equations(family, distorted, corrected, terms)
        if scaled:  # the scale is one more unknown, which drops out
            outwards = corrected.ravel() / np.linalg.norm(corrected)
            matrix = matrix - np.outer(outwards, outwards @ matrix)
            change = change - outwards * (outwards @ change)
        share = 1 / math.sqrt(len(distorted))
        rows.append(np.einsum("b,rk->rbk", phi, matrix).reshape(len(matrix), -1) * share)
        right.append(change * share)
    if isinstance(prepared, AbstractPriorZoom):
        prior = _prior(prepared, basis.shape[1] * size)
        rows.append(prior)
        right.append(np.zeros(len(prior)))
    a = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return with_parameters(prepared, jnp.asarray(a.reshape(basis.shape[1], size)))


def _equations(
    family: AbstractFamily, distorted: np.ndarray, corrected: np.ndarray, terms: int
) -> tuple[np.ndarray, np.ndarray]:
    """Linear equations for a node's coefficients in our order: matrix (row, coefficient), right side."""
    t = np.sum(distorted**2, axis=-1, keepdims=True)
    x, y = distorted.T
    radial = corrected if isinstance(family, Division) else distorted
    columns = [radial * t ** (i + 1) for i in range(terms)]
    if isinstance(family, BrownConrady):
        t = t[:, 0]
        columns += [np.stack([2 * x * y, t + 2 * y * y], -1), np.stack([t + 2 * x * x, 2 * x * y], -1)]
    change = distorted - corrected if isinstance(family, Division) else corrected - distorted
    return np.stack([column.ravel() for column in columns], axis=-1), change.ravel()


def _prior(zoom: AbstractPriorZoom, number: int) -> np.ndarray:
    """Rows whose sum of squares is the prior's part of the energy, times the number of nodes."""
    shape = jnp.shape(jnp.asarray(zoom.parameters))

    def row(flat):
        return with_parameters(zoom, flat.reshape(shape)).standardised()

    return float(zoom.error) * np.asarray(jax.vmap(row, out_axes=1)(jnp.eye(number)), float)


def _worst(lens: ZoomLens, focal: np.ndarray, points: list[Pairs], any_scale: list[bool]) -> float:
    """The greatest distance of corrected points to those of the file, px."""
    worst, centre = 0.0, np.asarray(lens.centre)
    for distortion, (distorted, corrected), scaled in zip(
        distortions(lens, focal), points, any_scale, strict=True
    ):
        found = (np.asarray(distortion.undistort(distorted * lens.scale + centre)) - centre) / lens.scale
        if scaled:
            corrected = corrected * np.sum(found * corrected) / np.sum(corrected * corrected)
        distance = np.hypot(*(found - corrected).T)
        worst = max(worst, float(distance.max()) if np.isfinite(distance).all() else np.inf)
    return worst * lens.scale
