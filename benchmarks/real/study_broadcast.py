"""Zoom models on the frames between: the true lenses of real broadcast cameras, 55 frames to learn from.

    python -m benchmarks.real.study_broadcast [--output FILE]

Five clips of the World Cup 2022, with focal length, principal point and OpenCV's k1 and k2 of every frame,
1920 x 1080 px. OpenCV's coefficients bend a straight image, ``x_d = x (1 + k1 r^2 + k2 r^4)`` with x in
focal lengths from the principal point; ours straighten a bent one, and no polynomial of ours is exactly
the inverse of one of theirs.

The data has the place of the camera, but where it looks in the first frame alone. So what it looks at is
drawn at random in every frame, a place on the pitch, level, and the real lines of a pitch are projected
through each frame's real lens: a point every `SPACING` px within the image, with noise. As in the paper a
clip's zoom model is fitted to 55 frames that cover its range of focal lengths evenly, and tested on all
others. Focal lengths are given; the centre of distortion is either that of the image, which is off by 6 to
34 px in the mean of a clip, or the mean principal point of the 55 frames.

Tested is, px: the straightness of the lines in the other frames (RMS, every frame weighing the same),
against the floor of their noise; and how far pixels are corrected to another place than by the true lens,
over the image and in its farthest corner. *Each frame by itself* is fitted to the very frame it is tested
on, and its straightness is that of the lines seen again, with other noise.

Results go to benchmarks/results/broadcast.md and broadcast.json.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax.focal.pitch import PITCH_LINES

from .study import DEFAULT, NONE, TERMS, choose, fitting, main, root_mean, table

SIZE = (1920, 1080)
SCALE = np.hypot(*SIZE) / 2
LEARNT = 55
SPACING, NOISE = 4.0, 0.5
SHORTEST = 40.0
"""px: of a line less is in view than this, it is not used."""
ROOM = len(PITCH_LINES)
EACH, TRUE = "each frame by itself", "the true lens"
ENTRIES = 6
KNOWN, ASSUMED = "principal point", "image centre"
CENTRES = {
    KNOWN: "The centre known: the mean principal point of the frames learnt from",
    ASSUMED: "The centre assumed: the middle of the image",
}
RIVALS = (
    f"table in 1/f, {ENTRIES} entries [25]",
    f"spline in 1/f, {ENTRIES} knots",
    "power law, k1 and k2",
)


@dataclass(frozen=True)
class Clip:
    """The lenses of one clip and where its camera stands.

    Attributes:
        name: of the clip.
        focal: of each frame, px.
        principal: of each frame, px: (frame, 2).
        k: OpenCV's k1 and k2 of each frame.
        position: of the camera, m, in the pitch's coordinates with z upwards.
    """

    name: str
    focal: np.ndarray
    principal: np.ndarray
    k: np.ndarray
    position: np.ndarray


def read_clip(path: Path) -> Clip:
    with np.load(path) as stored:
        camera, k, turn, shift = stored["K"], stored["k"], stored["R"][0], stored["t"][0]
    if np.any(k[:, 2:]) or np.any(camera[:, 0, 1]) or np.any(camera[:, 0, 0] != camera[:, 1, 1]):
        raise ValueError(f"The cameras of {path} have more than f, a principal point, k1 and k2.")
    return Clip(path.stem, camera[:, 0, 0], camera[:, :2, 2], k[:, :2], -turn.T @ shift)


def distorted(straight: np.ndarray, focal: float, k: np.ndarray) -> np.ndarray:
    """OpenCV's distortion of positions, px from the principal point."""
    squared = np.sum((straight / focal) ** 2, axis=-1, keepdims=True)
    return straight * (1 + squared * (k[0] + squared * k[1]))


def corrected(bent: np.ndarray, focal: np.ndarray, k: np.ndarray) -> np.ndarray:
    """The inverse of `distorted`, by Newton's method on the radius: (frame, point, 2).

    Raises:
        RuntimeError: it does not converge.
    """
    target = np.linalg.norm(bent, axis=-1) / focal[:, None]
    r, k1, k2 = target, *k.T[..., None]

    def bend(r):
        return r * (1 + r**2 * (k1 + r**2 * k2))

    for _ in range(20):
        r = r - (bend(r) - target) / (1 + r**2 * (3 * k1 + 5 * r**2 * k2))
    if not np.all(abs(bend(r) - target) < 1e-12):
        raise RuntimeError("OpenCV's distortion has no inverse in some frame.")
    return bent * (r / np.where(target > 0, target, 1))[..., None]


def looking_at(position: np.ndarray, aim: np.ndarray) -> np.ndarray:
    """The rotation of a level camera, rows to the right, down and ahead."""
    ahead = (aim - position) / np.linalg.norm(aim - position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def pitch_lines(clip: Clip, frame: int, turn: np.ndarray) -> list[np.ndarray]:
    """The pitch's lines seen through a frame's lens: points `SPACING` px apart, px, without noise."""
    focal, principal = clip.focal[frame], clip.principal[frame]
    reach = 1.3 * SCALE  # beyond the image; farther out OpenCV's polynomial may fold back into it
    found = []
    for ends in PITCH_LINES.values():
        ends = (np.pad(ends, ((0, 0), (0, 1))) - clip.position) @ turn.T
        depth = ends[:, 2]
        if depth.max() < 1:
            continue
        if depth.min() < 1:  # partly behind the camera
            hind = np.argmin(depth)
            share = (1 - depth[hind]) / (depth[1 - hind] - depth[hind])
            ends[hind] += share * (ends[1 - hind] - ends[hind])
        first, last = focal * ends[:, :2] / ends[:, 2:]
        length = np.linalg.norm(last - first)
        direction = (last - first) / length
        foot = -first @ direction  # of the perpendicular from the principal point, along the line
        chord = np.sqrt(max(reach**2 - np.sum((first + foot * direction) ** 2), 0))
        along = np.arange(max(0, foot - chord), min(length, foot + chord), SPACING)
        points = principal + distorted(first + along[:, None] * direction, focal, clip.k[frame])
        inside = points[np.all((points >= 0) & (points <= np.array(SIZE) - 1), axis=1)]
        if len(inside) * SPACING >= SHORTEST:
            found.append(inside)
    return found


def seen(clip: Clip, rng: np.random.Generator) -> tuple[list[np.ndarray], np.ndarray]:
    """The lines of all frames, and the frame of each: aims drawn until two lines or more are in view."""
    lines, frames = [], []
    for frame in range(len(clip.focal)):
        found = []
        while len(found) < 2:
            aim = rng.uniform([-42, -22, 0], [42, 22, 0])
            found = pitch_lines(clip, frame, looking_at(clip.position, aim))
        lines += found
        frames += [frame] * len(found)
    return lines, np.array(frames)


def with_noise(lines: zj.Lines, seed: int) -> zj.Lines:
    noise = NOISE * np.random.default_rng(seed).standard_normal(lines.points.shape)
    return eqx.tree_at(lambda lines: lines.points, lines, lines.points + noise)


def truly_straight(clip: Clip, lines: zj.Lines) -> np.ndarray:
    """RMS of each frame, px, as corrected by its true lens: the floor."""
    frame = np.asarray(lines.frame)
    offset = np.asarray(lines.points) - clip.principal[frame][:, None]
    points = corrected(offset, clip.focal[frame], clip.k[frame])
    straight = eqx.tree_at(lambda lines: lines.points, lines, jnp.asarray(points))
    return np.asarray(zj.frame_rms(straight, None))


def frame_by_frame(lines: zj.lines.CompressedLines, batch: int = 100) -> np.ndarray:
    """Coefficients of each frame from its own lines, some frames at a time."""
    frames = np.arange(len(lines.focal))
    found = [
        zj.fit_frames(choose(lines, np.resize(frames[start:], batch), ROOM), throw=False).coefficients
        for start in range(0, len(frames), batch)
    ]
    return np.concatenate(found)[: len(frames)]


def image_places() -> np.ndarray:
    """Pixels over the image, the four corners last."""
    right, bottom = np.array(SIZE) - 1.0
    x, y = np.meshgrid(np.linspace(0, right, 17), np.linspace(0, bottom, 10))
    corners = [(0, 0), (right, 0), (0, bottom), (right, bottom)]
    return np.concatenate([np.stack([x.ravel(), y.ravel()], axis=-1), corners])


@eqx.filter_jit
def _corrected_by(k, centre, places):
    return jax.vmap(lambda k: zj.Distortion(k, centre, jnp.asarray(SCALE)).undistort(places))(k)


def misplaced(clip: Clip, k: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances, px, between places as corrected by `k` and by the true lens, for each frame.

    Returns:
        Their RMS over the image, and the largest of the four corners.
    """
    places = image_places()
    ours = np.asarray(_corrected_by(jnp.asarray(k), jnp.asarray(centre), jnp.asarray(places)))
    principal = clip.principal[:, None]
    truth = principal + corrected(places - principal, clip.focal, clip.k)
    distance = np.linalg.norm(ours - truth, axis=-1)
    return root_mean(distance[:, :-4] ** 2), distance[:, -4:].max(axis=1)


def study_clip(clip: Clip, others: list[Clip]) -> dict:
    """Straightness and error of every model in the frames it has not seen, for both centres.

    And, with the centre known, the error in other clips of the same camera.
    """
    points, frame = seen(clip, np.random.default_rng(0))
    learnt = np.argsort(clip.focal)[np.linspace(0, len(clip.focal) - 1, LEARNT).round().astype(int)]
    unseen = np.setdiff1d(np.arange(len(clip.focal)), learnt)
    centres = {KNOWN: clip.principal[learnt].mean(axis=0), ASSUMED: (np.array(SIZE) - 1) / 2}
    result = {
        "frames": len(clip.focal),
        "lines": len(points),
        "points": sum(map(len, points)),
        "focal_px": [float(clip.focal.min()), float(clip.focal.max())],
        "centre_off_px": float(np.linalg.norm(clip.principal - centres[ASSUMED], axis=1).mean()),
        "not_fitted": {},
        "other_clips": {other.name: {} for other in others},
    }
    for place, centre in centres.items():
        lines = zj.Lines.from_ragged(
            points, frame, clip.focal, image_size=SIZE, focal_unit="px", centre=centre
        )
        first, again = zj.compress(with_noise(lines, 1)), zj.compress(with_noise(lines, 2))
        train = choose(first, learnt, ROOM)
        models, result["not_fitted"] = fitting(train, ENTRIES)
        k = {NONE: np.zeros((len(clip.focal), TERMS)), EACH: frame_by_frame(first)}
        k |= {model.name: model.coefficients(train, clip.focal) for model in models}
        floor = truly_straight(clip, with_noise(lines, 2))[unseen]
        result[place] = {
            TRUE: {"rms_px": float(root_mean(floor**2)), "image_px": 0.0, "corner_px": [0.0] * 3}
        }
        for name, values in k.items():
            straightness = np.asarray(zj.frame_rms(again, values))[unseen]
            image, corner = (error[unseen] for error in misplaced(clip, values, centre))
            result[place][name] = {
                "rms_px": float(root_mean(straightness**2)),
                "image_px": float(root_mean(image**2)),
                "corner_px": np.quantile(corner, [0.5, 0.95, 1]).tolist(),
            }
        for model, other in itertools.product(models if place == KNOWN else (), others):
            image, _ = misplaced(other, model.coefficients(train, other.focal), centre)
            result["other_clips"][other.name][model.name] = float(root_mean(image**2))
        print(clip.name, place, {name: x["rms_px"] for name, x in result[place].items()}, flush=True)
    return result


def run(data: Path) -> dict:
    """All measurements."""
    clips = [read_clip(path) for path in sorted((data / "broadcast_cameras").glob("*.npz"))]
    return {"clips": {clip.name: study_clip(clip, clips_to_test(clip, clips)) for clip in clips}}


def clips_to_test(clip: Clip, clips: list[Clip]) -> list[Clip]:
    """The other clips of a match, for the first of them, which has the widest range of focal lengths."""
    match = [other for other in clips if other.name[:7] == clip.name[:7]]
    return match[1:] if clip is match[0] else []


def page(r: dict) -> list[str]:
    """The results as a page."""
    clips = r["clips"]
    number = sum(clip["frames"] for clip in clips.values())
    points = sum(clip["points"] for clip in clips.values())
    low, high = min(c["focal_px"][0] for c in clips.values()), max(c["focal_px"][1] for c in clips.values())
    lines = [
        "# Frames not seen: real broadcast cameras",
        "",
        f"{number:,} frames, 1920 × 1080 px, of {len(clips)} clips with the true lens of each frame, focal "
        f"lengths {low:.0f} to {high:.0f} px. Synthetic is what is seen through the lenses: the lines of a "
        "pitch of 105 m by 68 m from where the camera really stands, looking at places drawn over the "
        f"pitch; {points / 1e6:.1f} million points, {SPACING:g} px apart, noise {NOISE} px. Each clip's "
        f"model is fitted to {LEARNT} frames and tested on all others.",
        "",
        "*Straightness* is the RMS distance of corrected points from straight lines. *Over the image* and "
        "*corner* are the distance between where the model and where the true lens corrects a pixel to: "
        "RMS, and the farthest of the four corners, in the middle frame and in 95 of 100. Straightness and "
        "RMS are the root of the mean square of the clips' figures, and corners their mean.",
        "",
    ]
    for place, text in CENTRES.items():
        names = list(dict.fromkeys(name for clip in clips.values() for name in clip[place]))
        lines += [
            f"## {text}",
            "",
            *table(
                ["model", "straightness, px", "over the image, px", "corner, px", "95 %"],
                ([name, *cells(together(clips, place, name))] for name in names),
            ),
            "",
            *better(clips, place, names),
            "",
        ]
    lines += [
        "## Clip by clip",
        "",
        "The centre known; straightness, px, and in parentheses the error over the image, px.",
        "",
        *table(
            ["model", *(name.replace("_", " ") for name in clips)],
            (
                [name, *(one_clip(clip[KNOWN].get(name)) for clip in clips.values())]
                for name in (TRUE, NONE, EACH, "zoom polynomial, degree 1", DEFAULT, *RIVALS)
            ),
        ),
        "",
        *table(
            ["", *(name.replace("_", " ") for name in clips)],
            [
                ["frames", *(f"{clip['frames']:,}" for clip in clips.values())],
                ["lines", *(f"{clip['lines']:,}" for clip in clips.values())],
                ["focal lengths, px", *("{:.0f} to {:.0f}".format(*c["focal_px"]) for c in clips.values())],
                ["centre from the image's, px", *(f"{c['centre_off_px']:.0f}" for c in clips.values())],
            ],
        ),
    ]
    lines += [
        "",
        "## Another clip of the same camera",
        "",
        "Fitted to 55 frames of one clip, tested on every frame of another of the same match: error over "
        "the image, px, with the centre of the clip learnt from.",
        "",
    ]
    tests = {(a, b): x for a, clip in clips.items() for b, x in clip["other_clips"].items()}
    lines += table(
        ["model", *(f"{a} → {b[-6:]}".replace("_", " ") for a, b in tests)],
        (
            [name, *(f"{x[name]:.2f}" if name in x else "–" for x in tests.values())]
            for name in dict.fromkeys(name for x in tests.values() for name in x)
        ),
    )
    reasons = {name: why for clip in clips.values() for name, why in clip["not_fitted"].items()}
    if reasons:
        lines += ["", "Not fitted: " + "; ".join(f"{a} (“{b}”)" for a, b in reasons.items()) + "."]
    return lines


def together(clips: dict, place: str, name: str) -> np.ndarray | None:
    """The four figures of one model over all clips; None if it could not be fitted to some."""
    figures = [clip[place].get(name) for clip in clips.values()]
    if None in figures:
        return None
    rms = [root_mean(np.array([x[key] for x in figures]) ** 2) for key in ("rms_px", "image_px")]
    return np.array([*rms, *np.mean([x["corner_px"][:2] for x in figures], axis=0)])


def better(clips: dict, place: str, names: list[str]) -> list[str]:
    """In what other models are ahead of degree 2 by more than the last digits."""
    default = together(clips, place, DEFAULT)
    assert default is not None
    sentences = []
    for column, what in enumerate(("Straighter", "Nearer to the truth over the image")):
        figures = {name: together(clips, place, name) for name in names if name not in (TRUE, EACH)}
        gains = {name: 1 - x[column] / default[column] for name, x in figures.items() if x is not None}
        ahead = [f"{name} (by {100 * gain:.2f} %)" for name, gain in gains.items() if gain > 0.0005]
        sentences.append(f"{what} than degree 2 by 0.05 % or more: {', '.join(ahead) or 'none'}.")
    return sentences


def cells(figures: np.ndarray | None) -> list[str]:
    if figures is None:
        return ["–"] * 4
    return [f"{figures[0]:.4f}", *(f"{figure:.2f}" for figure in figures[1:])]


def one_clip(x: dict | None) -> str:
    return "–" if x is None else f"{x['rms_px']:.4f} ({x['image_px']:.2f})"


if __name__ == "__main__":
    main(__doc__, "broadcast", run, page)
