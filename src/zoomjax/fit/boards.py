"""A zoom lens, focal lengths and the shape of a board from photos of it: bundle adjustment.

A printed board is seldom flat. Rows and columns of one that is bent are not straight in the image, whatever
the lens, and homographies of a flat board give wrong focal lengths. Seen from many sides its shape can be
told from the lens: poses, shape, focal lengths, distortion and its centre are fitted together, to distances
in the image. What is minimised says `_board_rows`; the solver is optimistix' Levenberg-Marquardt with
poses eliminated (`_board_schur`); the start comes from straightness and homographies (`_board_start`).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from .._core.arguments import kinds_checked
from .._core.arrays import as_jax
from .._core.checks import check_above
from .._core.fields import without_rounding
from .._core.programs import light_program
from .._core.types import AnyArray
from ..models.distortion_model import AbstractDistortionModel, checked_terms
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from ..models.requirements import check
from ..models.zoom import AbstractZoom, PolynomialZoom
from ._board_problem import checked_grids, data_of, padded_to
from ._board_rows import Model
from ._board_shape import grid_places
from ._board_stages import described, in_stages, located
from ._board_start import coefficients_of, filled, homographies, ordered, poses_of, through
from ._structure import bucket
from .result import RESULTS, ZoomFit, failed, judged
from .zoom import CentreArgument, given_centre

_CENTRE_STD = 0.05
"""Standard deviation of a fitted centre, half image diagonals, before there is any data: poses can stand in
for it where the lens is long."""

_HELD = 1e-9
"""The same of what is held."""

_UNKNOWN = 0.2
"""Standard deviation of log f from which a focal length is not determined."""

_FAILED = "The fit of the board failed: add photos of it, oblique and from several sides. "


class BoardPoses(NamedTuple):
    """Where a board is in photos.

    Attributes:
        rotation: from the board to the camera, whose axes are x right, y down and z forward. NaN, as all
            of a photo, where it shows no grid: its corners are on no lines.
        position: of the board's middle in the camera, steps of its grid.
        bend: how far each corner is out of the board's shape in this photo, away from the camera, steps of
            its grid: paper bends otherwise from photo to photo.
        residual: distance between each corner and where the model puts it, px; NaN where none is seen.
    """

    rotation: Float[Array, "photo 3 3"]
    position: Float[Array, "photo 3"]
    bend: Float[Array, "photo row column"]
    residual: Float[Array, "photo row column"]


class BoardFit(eqx.Module):
    """A zoom lens with its focal lengths, and the board that it was fitted to.

    Attributes:
        fit: the lens, with focal lengths in px, and its uncertainty. `ZoomFit.rms` is of the distances
            between corners and where the model puts them, px of the image, without outliers;
            `ZoomFit.frame_rms` has one for each photo, NaN where most of its corners are outliers, or it
            shows no grid.
            `ZoomFit.joint` includes the centre, if it was fitted. Its result is `undetermined` where a
            focal length is not.
        label: the labels of the zooms, in order.
        focal, focal_std: focal length of each and its standard deviation, px; infinite where most corners
            of its photos are outliers.
        frame_focal: focal length of each photo, px.
        covariance: of log f of each zoom, of the zoom model's parameters, and of the centre, half image
            diagonals: photos are taken to err each by itself. Focal length and distance stand in for each
            other where the board is seen squarely: the variances of log f say so.
        board: for each photo the number of its board.
        shape: where each corner of each board is, steps of the grid, about its middle: x along rows, y
            along columns, z away from the camera.
        shape_std: its standard deviation.
        coefficients: the shape as the fit has it, of its smooth functions.
        bend_std: standard deviation of the functions that photos have beside it, half longer sides.
        poses: of the board in each photo.
        noise: standard deviation of a corner's coordinate, px.
    """

    fit: ZoomFit
    label: Float[Array, "zoom"]
    focal: Float[Array, "zoom"]
    focal_std: Float[Array, "zoom"]
    frame_focal: Float[Array, "photo"]
    covariance: Float[Array, "all all"]
    board: Int[Array, "photo"]
    shape: Float[Array, "board row column 3"]
    shape_std: Float[Array, "board row column 3"]
    coefficients: Float[Array, "board function"]
    bend_std: Float[Array, ""]
    poses: BoardPoses
    noise: Float[Array, ""]

    @property
    def lens(self) -> ZoomLens:
        """The zoom lens."""
        return self.fit.lens

    @property
    def bend(self) -> Float[np.ndarray, "board"]:
        """How far each board reaches out of its plane, from its deepest to its highest corner, steps."""
        height = np.asarray(self.shape)[..., 2]
        return height.max(axis=(1, 2)) - height.min(axis=(1, 2))

    def locate(
        self,
        grids: Sequence[Any] | AnyArray,
        focal: Num[AnyArray, "photo"] | Sequence[float | int],
        *,
        board: Int[AnyArray, "photo"] | Sequence[int] | None = None,
    ) -> BoardPoses:
        """The poses of the same boards in other photos, for the lens and the shapes of this fit.

        How the board bends in each photo beside its shape is fitted, too.

        Args:
            grids: as for `fit_boards`.
            focal: the labels of their zooms, which are among those fitted.
            board: their boards, by default the first.

        Raises:
            ValueError: a grid has another size, or a label or a board is not among those fitted.
        """
        given = checked_grids(grids, focal, board, self.lens.image_size, self.shape.shape[1:3])
        lens, zooms = self.lens, len(self.label)
        known, label = np.split(without_rounding(np.append(self.label, given.label)), [zooms])
        number = np.searchsorted(known, label).clip(0, zooms - 1)
        strange = known[number] != label
        if strange.any():
            raise ValueError(
                f"Argument focal must be among the labels fitted, {known.tolist()}, but it holds "
                f"{given.label[strange][0]:g}."
            )
        boards = len(self.shape)
        if given.board.max() >= boards:
            raise ValueError(
                f"Argument board must be among the {boards} boards fitted, from 0, but it holds "
                f"{given.board.max()}."
            )
        data = data_of(given, number, zooms, np.asarray(lens.centre), _HELD, boards=boards)
        coefficients = padded_to(np.asarray(jax.vmap(lens.zoom)(self.focal)), len(data.smooth))
        matrices, *_ = _homographies(data, coefficients, lens.distortion_model)
        start = _model(
            data, matrices, np.asarray(self.focal), lens.zoom, lens.distortion_model, bucket(boards)
        )
        start = eqx.tree_at(
            lambda model: model.shape, start, padded_to(np.asarray(self.coefficients), bucket(boards))
        )
        return _poses(given, data, *located(data, start, self.noise, self.bend_std))

    def flattening(self) -> Float[np.ndarray, "photo row column 2"]:
        """How much elsewhere each corner would be seen if the board were flat and even, px.

        Added to the corners that were seen, it makes rows and columns straight in the scene. NaN where the
        lens shows no such point.
        """
        rows, columns = self.shape.shape[1:3]
        places, unit = grid_places(rows, columns)
        flat = np.pad(places * unit, ((0, 0), (0, 1)))
        shape = np.asarray(self.shape).reshape(len(self.shape), -1, 3)
        bend = np.asarray(self.poses.bend).reshape(len(self.frame_focal), -1)
        rotation, position = np.asarray(self.poses.rotation), np.asarray(self.poses.position)
        moved = []
        for photo, (focal, board) in enumerate(
            zip(self.frame_focal.tolist(), self.board.tolist(), strict=True)
        ):
            bent = shape[board] + np.pad(bend[photo, :, None], ((0, 0), (2, 0)))
            ahead = np.stack([flat, bent]) @ rotation[photo].T + position[photo]
            straight = np.asarray(self.lens.centre) + focal * ahead[..., :2] / ahead[..., 2:]
            seen = np.asarray(self.lens(focal).distort(straight))
            moved.append((seen[0] - seen[1]).reshape(rows, columns, 2))
        return np.stack(moved)

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: call the lens of the fit instead."""
        raise TypeError("A BoardFit is not a lens: use fit.lens, as in fit.lens(2400.0).")


@kinds_checked
def fit_boards(
    grids: Sequence[Any] | AnyArray,
    focal: Num[AnyArray, "photo"] | Sequence[float | int],
    *,
    image_size: Sequence[int],
    zoom: AbstractZoom | None = None,
    distortion_model: AbstractDistortionModel | None = None,
    terms: int = 2,
    centre: CentreArgument = "fit",
    board: Int[AnyArray, "photo"] | Sequence[int] | None = None,
    smooth: float | int | None = None,
    flat: bool = False,
    throw: bool = True,
) -> BoardFit:
    """Fit a zoom lens, focal lengths and the shape of a board to photos of it, all of one board.

    Computed in float64, which has to be enabled. Sets of photos, corners and zooms are padded to a few
    sizes, so that others do not compile again.

    Args:
        grids: the corners of the board in each photo, px, (row, column, 2), NaN where none is seen:
            `zoomjax.detect.GridDetector.find` gives them. The same corner of the board has the same place
            in all, of at least 3 rows and 3 columns.
        focal: for each photo the label of its zoom, above 0: photos of one label share a focal length,
            which is fitted. Labels are in the order of the focal lengths, such as those of the zoom ring
            or of EXIF data, and need not be exact.
        image_size: width and height of the photos, px.
        zoom: the zoom model; by default `PolynomialZoom` of degree 2, or less where there are fewer zooms.
        distortion_model: the distortion model; `RadialPolynomial` by default.
        terms: the number N of radial distortion coefficients.
        centre: of distortion, which is the principal point, too: "fit", "image", or two coordinates, px.
        board: for each photo the number of its board, from 0, if there are several of one size, or if one
            was bent otherwise in between, as paper is from day to day. By default all show the same.
        smooth: standard deviation of log f beside a parabola in the logarithm of the label: 0.01 if focal
            lengths lie on a smooth curve within a per cent; of no effect with three zooms or fewer. By
            default they are free.
        flat: whether the board is flat.
        throw: whether to raise if the fit fails. Otherwise see `ZoomFit.result`. `undetermined` and
            `folded` never raise.

    Raises:
        ValueError: float64 is not enabled; grids are of several sizes, or hold too few corners; or there is
            not one positive label for each.
        RuntimeError: the fit failed (see `throw`).

    References:
        K. H. Strobl, G. Hirzinger, "More accurate pinhole camera calibration with imperfect planar
        target", ICCV Workshops 2011: the board's shape as unknowns.
        B. Triggs et al., "Bundle adjustment: a modern synthesis", 2000.
    """
    if jnp.result_type(float) != jnp.float64:
        raise ValueError(
            "fit_boards needs float64, and it is not enabled: call "
            'jax.config.update("jax_enable_x64", True) first.'
        )
    given = checked_grids(grids, focal, board, image_size)
    given = given._replace(grids=np.where(ordered(given.grids)[:, None, None, None], given.grids, np.nan))
    label, number = np.unique(given.label, return_inverse=True)
    zoom = PolynomialZoom(degree=min(2, len(label) - 1)) if zoom is None else zoom
    check("fit_boards", zoom=zoom)
    distortion_model = RadialPolynomial() if distortion_model is None else distortion_model
    terms = checked_terms(terms, distortion_model.most_terms)
    fitted = isinstance(centre, str) and centre == "fit"
    origin = given_centre("image" if fitted else centre, given.image_size, stacklevel=4)
    if smooth is not None:
        check_above(0, smooth=smooth)
    data = data_of(given, number, len(label), origin, _CENTRE_STD if fitted else _HELD, smooth, label)
    lens = (given.image_size, origin, distortion_model, terms, len(label))
    wide = padded_to(coefficients_of(given.grids, number, *lens), len(data.smooth))
    matrices, found, std = _homographies(data, wide, distortion_model)
    focal_px = filled(found[: len(label)], std[: len(label)], label) * data.scale
    ready = zoom.prepare(focal_px, distortion_model.num_coefficients(terms))
    ready = through(ready, padded_to(focal_px, len(wide)), wide)
    boards = int(given.board.max()) + 1
    start = _model(data, matrices, focal_px, ready, distortion_model, bucket(boards))
    model, stage, result, steps = in_stages(data, start, flat=flat)
    fit = _described(given, data, (model, stage, result, steps), label, origin, fitted)
    return _thrown(fit) if throw else fit


def _homographies(data, coefficients, distortion_model):
    found = homographies(
        data.points, data.there, data.zoom, data.places, coefficients, distortion_model, data.scale
    )
    return found[0], *(np.asarray(of) for of in found[1:])


def _model(data, matrices, focal_px, zoom, distortion_model, boards):
    """Poses from homographies, of a flat board."""
    focal = np.asarray(padded_to(focal_px, len(data.smooth)))
    rotation, position = _start_poses(matrices, focal[np.asarray(data.zoom)] / data.scale)
    return Model(
        rotation=rotation,
        position=position,
        bend=as_jax(np.zeros((len(data.points), data.basis.own.shape[1]))),
        shape=as_jax(np.zeros((boards, data.basis.size))),
        log_focal=as_jax(np.log(focal)),
        zoom=zoom,
        offset=as_jax(np.zeros(2)),
        distortion_model=distortion_model,
    )


_start_poses, _judged = light_program(poses_of), light_program(judged)


def _poses(given, data, model, missed):
    """The poses of the photos there are."""
    photos, rows, columns = given.grids.shape[:3]
    unit = grid_places(rows, columns)[1]
    own = np.asarray(data.basis.own)[: rows * columns]
    bend = np.asarray(model.bend)[:photos] @ own.T
    distance = np.linalg.norm(np.asarray(missed), axis=-1)
    distance = np.where(np.asarray(data.there), distance, np.nan)[:photos, : rows * columns]
    known = np.isfinite(given.grids[..., 0]).any(axis=(1, 2))
    return BoardPoses(
        rotation=as_jax(np.where(known[:, None, None], np.asarray(model.rotation)[:photos], np.nan)),
        position=as_jax(np.where(known[:, None], np.asarray(model.position)[:photos] * unit, np.nan)),
        bend=as_jax(unit * bend.reshape(photos, rows, columns)),
        residual=as_jax(distance.reshape(photos, rows, columns)),
    )


def _described(given, data, solved, label, origin, fitted):
    """The fit, of the photos and zooms there are, in steps of the grid."""
    model, stage, result, steps = solved
    photos, rows, columns = given.grids.shape[:3]
    zooms, boards, corners = len(label), int(given.board.max()) + 1, rows * columns
    unit = grid_places(rows, columns)[1]
    focal = np.exp(np.asarray(model.log_focal)[:zooms])
    centre = as_jax(np.asarray(origin) + (data.scale * np.asarray(model.offset) if fitted else 0.0))
    focal_range = as_jax(np.array([focal.min(), focal.max()]))
    known = described(data, model, stage, centre, given.image_size, focal_range)
    all_numbers = np.asarray(known.covariance)
    kept = np.r_[:zooms, len(model.log_focal) : len(all_numbers)]
    covariance = all_numbers[np.ix_(kept, kept)]
    squares = np.where(np.asarray(known.inlier), np.sum(np.asarray(known.missed) ** 2, axis=-1), 0)[:photos]
    counts, seen = (np.asarray(of).sum(axis=1)[:photos] for of in (known.inlier, data.there))
    number = np.asarray(data.zoom)[:photos]
    fitted_there, seen_there = (np.bincount(number, of) for of in (counts, seen))
    lost = np.flatnonzero((2 * fitted_there < seen_there) | (seen_there == 0))
    covariance[lost] = covariance[:, lost] = 0
    covariance[lost, lost] = np.inf  # what fits few of its corners says nothing of a zoom
    log_std = np.sqrt(np.diag(covariance)[:zooms])
    size = sum(leaf.size for leaf in jax.tree.leaves(model.zoom.parameters))
    joint = covariance[zooms:, zooms:]
    rms = as_jax(np.sqrt(squares.sum() / max(counts.sum(), 1)))
    of_photos = np.sqrt(squares.sum(axis=1) / np.maximum(counts, 1))
    lens = ZoomLens(
        zoom=model.zoom,
        centre=centre,
        focal_range=focal_range,
        image_size=given.image_size,
        focal_unit="px",
        distortion_model=model.distortion_model,
    )
    determined = bool(np.isfinite(covariance).all() and log_std.max() < _UNKNOWN)
    shape, shape_std = (np.asarray(of)[:boards, :corners] for of in (known.shape, known.shape_std))
    fit = ZoomFit(
        lens=lens,
        rms=rms,
        frame_rms=as_jax(np.where((2 * counts >= seen) & (seen > 0), of_photos, np.nan)),
        covariance=as_jax(joint[:size, :size]),
        result=_judged(model.zoom, result, np.asarray(determined), known.certificate),
        steps=as_jax(np.asarray(steps)),
        certificate=known.certificate,
        rms_unconstrained=rms,
        joint=as_jax(joint) if fitted else None,
    )
    return BoardFit(
        fit=fit,
        label=as_jax(label),
        focal=as_jax(focal),
        focal_std=as_jax(focal * log_std),
        frame_focal=as_jax(focal[number]),
        covariance=as_jax(covariance),
        board=as_jax(given.board),
        shape=as_jax(unit * shape.reshape(boards, rows, columns, 3)),
        shape_std=as_jax(unit * shape_std.reshape(boards, rows, columns, 3)),
        coefficients=as_jax(np.asarray(model.shape)[:boards]),
        bend_std=as_jax(np.asarray(stage.bend)),
        poses=_poses(given, data, model, known.missed),
        noise=known.noise,
    )


def _thrown(fit):
    """The fit, raising RuntimeError where its solver failed."""
    if bool(failed(fit.fit.result)):
        raise RuntimeError(_FAILED + RESULTS[fit.fit.result])
    return fit
