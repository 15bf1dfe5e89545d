"""Photos that are searched for lines again under the lens of all of them."""

import dataclasses

import cv2
import numpy as np
import pytest

import zoomjax as zj
from tests.detect.test_wide import SIZE, windows
from zoomjax.app.image_calibration import calibrate_images
from zoomjax.app.image_job import ImageJob
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.tying import bend_at, better, tied, to_search_again
from zoomjax.detect.batch import NO_LINES, Detection
from zoomjax.detect.bend import bends_apart


def lens(k=0.1):
    """One focal length, one coefficient."""
    points = [np.stack([np.linspace(5, 470, 40), np.full(40, y)], -1) for y in (20.0, 80.0, 230.0, 300.0)]
    points += [np.stack([np.full(40, x), np.linspace(5, 310, 40)], -1) for x in (20.0, 130.0, 300.0, 460.0)]
    bent = zj.Distortion(np.array([k]), np.array([239.5, 159.5]), np.hypot(*SIZE) / 2).distort(
        np.stack(points)
    )
    lines = zj.Lines.from_ragged(list(bent), [0] * 8, [1.0], image_size=SIZE)
    return zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=0), terms=1).lens


def found(name, bend, lines=1, unexplained=0.2, problem=""):
    line = np.stack([np.linspace(5, 400, 50), np.full(50, 20.0)], axis=-1)
    return Detection(
        name, image_size=SIZE, lines=(line,) * lines, unexplained=unexplained, bend=bend, problem=problem
    )


def test_photos_that_agree_are_left_alone():
    known, flat = bend_at(lens(), 1.0), (0.0, 0.0, 0.0, 0.0)
    assert bends_apart(SIZE, known, known) < 1e-3
    photos = [found(name, known) for name in "abc"]
    photos += [found("d", flat), found("e", known, lines=0, problem=NO_LINES), found("f", None)]
    focal = dict.fromkeys("abcdef", 1.0)
    assert set(to_search_again(photos, focal, lens())) == {"d", "e"}
    assert to_search_again(photos, dict.fromkeys("abc", 1.0), lens()) == {}
    assert to_search_again(photos[-3:], focal, lens()) == {}  # two photos determine no lens for a third


def test_what_the_lens_makes_straight_is_kept():
    known, flat = bend_at(lens(), 1.0), (0.0, 0.0, 0.0, 0.0)
    one = zj.Distortion(np.array([0.1]), np.array([239.5, 159.5]), np.hypot(*SIZE) / 2)
    straight = np.asarray(one.distort(found("", flat).lines[0]))
    own = found("a", flat, lines=2)
    again = dataclasses.replace(own, lines=(straight,), bend=known, unexplained=0.5)
    assert better(own, again, known)
    assert not better(own, dataclasses.replace(again, unexplained=0.9), known)  # another lens's photo
    assert not better(own, dataclasses.replace(again, lines=(), problem=NO_LINES), known)
    assert not better(again, own, known)
    assert better(dataclasses.replace(own, lines=(), problem=NO_LINES), again, known)
    detections, names = tied([own, found("b", known)], {"a": known}, lambda known: [again])
    assert names == ["a"]
    assert detections[0] is again


def arena(square):
    """A floor of concentric rings, with two dashed lines, as `windows` is seen."""
    wide, high = SIZE[0] * 3, SIZE[1] * 3
    y, x = np.mgrid[0:high, 0:wide]
    z = (np.stack([x, y], axis=-1) + 0.5 - np.array([wide, high]) / 2) / 3 / (np.hypot(*SIZE) / 2)
    t = square * np.sum(z * z, axis=-1)
    flat = z * (1 + t / 3 + 2 * t * t / 15)[..., None]
    u, v = np.moveaxis(flat, -1, 0)
    wall = np.where(np.hypot(u - 0.1, v - 2.2) % 0.12 < 0.03, 90.0, 160.0)
    for place in (-0.62, 0.05, 0.6):
        wall[(abs(u - place - 0.05 * v) < 0.02) & (v % 0.2 < 0.12)] = 40
    return cv2.resize(wall, SIZE, interpolation=cv2.INTER_AREA).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_a_photo_of_arcs_is_searched_again(tmp_path, workers):
    """By itself it is taken for bent otherwise, and arcs for lines."""
    square = 0.3
    for n in range(4):
        cv2.imwrite(str(tmp_path / f"{n}.png"), windows(square, noise=1.0 + n))
    cv2.imwrite(str(tmp_path / "arcs.png"), arena(square))
    job = ImageJob(
        (tmp_path,),
        focal="20",
        workers=workers,
        cache=tmp_path / "cache",
        model=WantedModel("polynomial", 0),
    )
    done = calibrate_images(job)
    assert done.tied == ("arcs.png",)
    apart = calibrate_images(dataclasses.replace(job, tied=False))
    assert apart.tied == ()
    assert calibrate_images(job).tied == done.tied  # from the cache
    verdicts = {row["name"]: row["verdict"] for row in done.about()["images"]}
    assert [verdicts[f"{n}.png"] for n in range(4)] == ["good"] * 4
    alone = dict(zip((d.name for d in apart.used), apart.verdicts(), strict=True))
    assert alone.get("arcs.png", ("not determined", "x"))[0] != "good"
    assert all(reason for verdict, reason in alone.values() if verdict != "good")
