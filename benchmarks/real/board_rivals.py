"""Boards that are bent, beside what other programs make of them: OpenCV's release of the object, and mrcal.

    python -m benchmarks.real.board_rivals [--output FILE]

The photos, and the first pair of halves, of boards.py. All is fitted to one half and judged by the other.
`fit_boards` fits all zooms together, the others each zoom by itself: `cv2.calibrateCamera` (a flat board,
k1 and k2), `cv2.calibrateCameraRO` (each corner of the board is free; the same lens, or that of mrcal's
OPENCV4, in which both focal lengths and two tangential terms are free, too), and mrcal (the board is flat,
or bent by a parabola along each side). The last two run in processes of their own, with a time limit. Where
no Python on the path imports mrcal (`apt install python3-mrcal`), the page says so.

*Photos not seen*: RMS distance of corners from where the model puts them, with lens and shape of the board
as they were fitted, and the pose refitted by least squares. For that the lens of `fit_boards` is written in
OpenCV's form, so that all go the same way.

Results go to benchmarks/results/board_rivals.md and board_rivals.json.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

import zoomjax as zj

from .boards import SIZE, fitted, halves, not_seen, off_curve, opencv, rms
from .study import main, table
from .zoomcam import read_corners

LIMIT = 60
"""Seconds that a fit of another program may take."""

FOCAL = 4000.0
"""Where the focal lengths of others start, px."""

FREE = "`cv2.calibrateCameraRO`, lens as OPENCV4"

RELEASE = """
import json, sys, time
import cv2, numpy as np
given = json.load(sys.stdin)
corners = np.array(given["corners"], np.float32)
photos, rows, columns = corners.shape[:3]
y, x = np.indices((rows, columns)).reshape(2, -1)
board = np.stack([x, y, 0 * x], axis=1).astype(np.float32)
width, height = given["size"]
start = np.array([[given["focal"], 0, (width - 1) / 2], [0, given["focal"], (height - 1) / 2], [0, 0, 1]])
flags = cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
if not given["free"]:
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
if given["no_schur"]:  # the flag is also that of a tilted sensor, whose angles are held at nothing
    flags |= getattr(cv2, "CALIB_DISABLE_SCHUR_COMPLEMENT", 0) | cv2.CALIB_FIX_TAUX_TAUY
if given["lu"]:
    flags |= cv2.CALIB_USE_LU
until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 1e-6)
begin = time.perf_counter()
try:
    error, matrix, k, _, _, board = cv2.calibrateCameraRO(
        [board] * photos, list(corners.reshape(photos, -1, 1, 2)), (width, height),
        given["fixed"], start, None, flags=flags, criteria=until
    )
except cv2.error as problem:
    print(json.dumps({"error": str(problem).strip()}))
else:
    print(json.dumps({
        "rms": error, "matrix": matrix.tolist(), "k": k.ravel().tolist(),
        "board": board.reshape(-1, 3).tolist(), "seconds": time.perf_counter() - begin,
    }))
"""
"""`cv2.calibrateCameraRO` with the lens of `opencv`, or with that of mrcal's OPENCV4."""

MRCAL = """
import json, sys, time
import mrcal, numpy as np
given = json.load(sys.stdin)
corners, size = np.array(given["corners"]), np.array([given["size"]], np.int32)
photos, rows, columns = corners.shape[:3]
seen = np.concatenate([corners, np.ones((photos, rows, columns, 1))], axis=-1)
index = np.array([[i, 0, -1] for i in range(photos)], np.int32)
begin = time.perf_counter()
lens, _, poses = mrcal.seed_stereographic(
    imagersizes=size, focal_estimate=given["focal"], indices_frame_camera=index[:, :2].copy(),
    observations=seen, object_spacing=1.0,
)
warp = None

def solve(model, warped=False, outliers=False, **options):
    return mrcal.optimize(
        intrinsics=lens, extrinsics_rt_fromref=None, frames_rt_toref=poses, points=None,
        observations_board=seen, indices_frame_camintrinsics_camextrinsics=index,
        observations_point=None, indices_point_camintrinsics_camextrinsics=None,
        lensmodel=model, imagersizes=size, calibration_object_spacing=1.0, verbose=False,
        calobject_warp=warp, do_optimize_calobject_warp=warped, do_apply_outlier_rejection=outliers,
        **options,
    )

simple = "LENSMODEL_STEREOGRAPHIC"
solve(simple, do_optimize_intrinsics_core=False, do_optimize_intrinsics_distortions=False)
solve(simple, do_optimize_intrinsics_distortions=False)
more = mrcal.lensmodel_num_params(given["model"]) - 4
lens = np.hstack([lens, (np.random.default_rng(0).random((1, more)) - 0.5) * 2e-6])
solved = solve(given["model"])
if given["warp"]:
    warp = np.full(2, 1e-3)
    solved = solve(given["model"], warped=True)
if given["outliers"]:
    solved = solve(given["model"], warped=given["warp"], outliers=True)
fx, fy, cx, cy = lens[0, :4]
board = mrcal.ref_calibration_object(columns, rows, 1.0, calobject_warp=warp)
print(json.dumps({
    "rms": float(solved["rms_reproj_error__pixels"]), "outliers": int(solved["Noutliers"]),
    "matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "k": lens[0, 4:].tolist(),
    "board": board.reshape(-1, 3).tolist(), "seconds": time.perf_counter() - begin,
}))
"""
"""mrcal, in the steps of its own command: a simple lens, the lens, the board's shape, outliers."""

MODELS = {
    "mrcal, OPENCV4, flat board": {"model": "LENSMODEL_OPENCV4", "warp": False, "outliers": True},
    "mrcal, OPENCV4, bent board": {"model": "LENSMODEL_OPENCV4", "warp": True, "outliers": True},
    "the same, outliers kept": {"model": "LENSMODEL_OPENCV4", "warp": True, "outliers": False},
    "mrcal, OPENCV8, flat board": {"model": "LENSMODEL_OPENCV8", "warp": False, "outliers": True},
    "mrcal, OPENCV8, bent board": {"model": "LENSMODEL_OPENCV8", "warp": True, "outliers": True},
}
"""Fits of mrcal."""


def asked(python: str, program: str, corners: np.ndarray, limit: float = LIMIT, **given: object) -> dict:
    """What another program found, or `error` that says why it found nothing."""
    text = json.dumps({"corners": corners.tolist(), "size": SIZE, "focal": FOCAL, **given})
    try:
        done = subprocess.run(
            [python, "-c", program], input=text, capture_output=True, text=True, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return {"error": f"does not end within {limit:g} s"}
    if done.returncode:
        return {"error": (done.stderr.strip().splitlines() or ["ends without a word"])[-1]}
    return json.loads(done.stdout)


def released(corners: np.ndarray, *, fixed: int | None = None, **options: bool) -> dict:
    """`cv2.calibrateCameraRO`; its manual advises to hold the last corner of the first row."""
    fixed = corners.shape[2] - 1 if fixed is None else fixed
    given = {"free": False, "lu": True, "no_schur": True} | options
    return asked(sys.executable, RELEASE, corners, fixed=fixed, **given)


def python_with_mrcal() -> str | None:
    """The first Python on the path that imports mrcal."""
    for folder in os.get_exec_path():
        python = Path(folder) / "python3"
        if (
            python.exists()
            and not subprocess.run([python, "-c", "import mrcal"], capture_output=True).returncode
        ):
            return str(python)
    return None


def version_of_mrcal() -> str:
    """As the package of Debian says."""
    if not shutil.which("dpkg-query"):
        return ""
    query = ["dpkg-query", "-W", "-f", "${Version}", "python3-mrcal"]
    return subprocess.run(query, capture_output=True, text=True).stdout.strip()


def missed(found: dict, others: np.ndarray) -> np.ndarray:
    """Distances of corners of photos not seen, the pose being the best in the sense of least squares.

    The search starts from the pose of a flat board: of one that is nearly flat OpenCV finds none.
    """
    rows, columns = others.shape[1:3]
    matrix, k, board = (np.array(found[name], float) for name in ("matrix", "k", "board"))
    y, x = np.indices((rows, columns)).reshape(2, -1)
    flat = np.stack([x, y, 0 * x], axis=1).astype(float)
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    distances = []
    for grid in others:
        seen = grid.reshape(-1, 1, 2)
        _, turn, shift = cv2.solvePnP(flat, seen, matrix, k)
        turn, shift = cv2.solvePnPRefineLM(board, seen, matrix, k, turn, shift, until)
        placed, _ = cv2.projectPoints(board, turn, shift, matrix, k)
        distances.append(np.linalg.norm(placed.reshape(rows, columns, 2) - grid, axis=-1))
    return np.array(distances)


def measured(both: list[list[dict]], corners: np.ndarray, zoom: np.ndarray, first: np.ndarray) -> dict:
    """Of fits to both halves, a zoom at a time: photos not seen, and how well the halves agree.

    NaN at zooms where one of the fits found nothing.
    """
    labels = np.unique(zoom)
    distance, apart, bent, focal = [], [], [], np.full((2, len(labels)), np.nan)
    for i, label in enumerate(labels):
        mine = zoom == label
        if any("error" in half[i] for half in both):
            distance.append(np.full((1, 1, 1), np.nan))
            apart.append(float("nan"))
            bent.append(float("nan"))
            continue
        for half, (fits, seen) in enumerate(zip(both, (first, ~first), strict=True)):
            focal[half, i] = np.sqrt(fits[i]["matrix"][0][0] * fits[i]["matrix"][1][1])
            distance.append(missed(fits[i], corners[mine & ~seen]))
        distance[-2:] = [np.concatenate(distance[-2:])]
        points = corners[mine].reshape(-1, 1, 2)
        lenses = [(np.array(fits[i]["matrix"]), np.array(fits[i]["k"])) for fits in both]
        a, b = (cv2.undistortPoints(points, m, k, P=m).reshape(-1, 2) for m, k in lenses)
        apart.append(rms(np.linalg.norm(a - b, axis=-1)))
        matrix, _ = cv2.findHomography(a, b, 0)
        moved = cv2.perspectiveTransform(a[:, None], matrix)[:, 0]
        bent.append(rms(np.linalg.norm(moved - b, axis=-1)))
    return distances_of(distance) | {
        "scatter": apart,
        "scatter_bent": bent,
        "focal": focal.mean(axis=0).tolist(),
        "repeats": np.abs((focal[0] - focal[1]) / focal.mean(axis=0)).tolist(),
        "off_curve": max(off_curve(labels, of) for of in focal),
        "seconds": float(sum(fit.get("seconds", 0.0) for half in both for fit in half)),
        "outliers": sum(fit.get("outliers", 0) for half in both for fit in half),
        "errors": sorted({fit["error"] for half in both for fit in half if "error" in fit}),
        "centre": [[np.array(f["matrix"])[:2, 2].tolist() for f in half if "matrix" in f] for half in both],
        "bend": [
            [float(np.ptp(np.array(f["board"])[:, 2])) for f in half if "board" in f] for half in both
        ],
    }


def distances_of(distance: list[np.ndarray]) -> dict:
    """Figures of distances at each zoom."""
    every = np.concatenate([of.ravel() for of in distance])
    return {
        "not_seen": rms(every) if np.isfinite(every).all() else float("nan"),
        "not_seen_by_zoom": [rms(of) for of in distance],
        "median": float(np.median(every)),
    }


def in_opencv(lens: zj.ZoomLens, focal: float, shape: np.ndarray) -> dict:
    """A lens of `fit_boards` at a focal length in the form of OpenCV, k1 to k6, and a board."""
    matrix = np.diag([focal, focal, 1.0])
    matrix[:2, 2] = np.asarray(lens.centre)
    points = np.stack(np.meshgrid(*(np.linspace(0, size - 1, 41) for size in SIZE)), axis=-1)
    points = points.reshape(-1, 2)
    seen = (points - matrix[:2, 2]) / focal
    ideal = (np.asarray(lens(focal).undistort(jnp.asarray(points))) - matrix[:2, 2]) / focal
    powers = np.sum(np.square(ideal), axis=-1)[:, None] ** np.arange(1, 4)
    terms = np.concatenate([powers[:, None] * ideal[..., None], -powers[:, None] * seen[..., None]], -1)
    terms = terms.reshape(-1, 6)
    size = np.linalg.norm(terms, axis=0)
    k = np.linalg.lstsq(terms / size, (seen - ideal).ravel(), rcond=1e-10)[0] / size
    k = np.array([*k[:2], 0, 0, *k[2:]])
    ahead = np.pad(ideal, ((0, 0), (0, 1)), constant_values=1)
    placed, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), matrix, k)
    rows, columns = shape.shape[:2]
    board = shape + np.array([(columns - 1) / 2, (rows - 1) / 2, 0])
    return {
        "matrix": matrix.tolist(),
        "k": k.tolist(),
        "board": board.reshape(-1, 3).tolist(),
        "off": float(np.linalg.norm(placed[:, 0] - points, axis=-1).max()),
    }


def ours(corners: np.ndarray, zoom: np.ndarray, first: np.ndarray) -> dict:
    """`fit_boards` on both halves, as the others, and with the board's bend in photos not seen refitted."""
    labels, both = np.unique(zoom), (first, ~first)
    fits = [fitted(corners[mine], zoom[mine], flat=False) for mine in both]
    forms = [
        [
            in_opencv(fit.lens, focal, shape)
            for focal, shape in zip(fit.focal.tolist(), np.asarray(fit.shape), strict=True)
        ]
        for fit in fits
    ]
    pose = measured(forms, corners, zoom, first)
    out = {"pose": pose, "off": max(form["off"] for half in forms for form in half)}
    for name, rigid in {"robust_pose": True, "bend": False}.items():
        found = [
            not_seen(fit, corners[~mine], zoom[~mine], rigid=rigid)
            for fit, mine in zip(fits, both, strict=True)
        ]
        out[name] = distances_of(
            [
                np.concatenate([of[zoom[~mine] == label] for of, mine in zip(found, both, strict=True)])
                for label in labels
            ]
        )
    return out


def each(
    fit: Callable[[np.ndarray], dict], corners: np.ndarray, zoom: np.ndarray, first: np.ndarray
) -> dict:
    """A fit to each zoom of both halves, measured."""
    both = [[fit(corners[mine & (zoom == q)]) for q in np.unique(zoom)] for mine in (first, ~first)]
    return measured(both, corners, zoom, first)


def flat(corners: np.ndarray) -> dict:
    """`cv2.calibrateCamera`, as in boards.py."""
    rows, columns = corners.shape[1:3]
    y, x = np.indices((rows, columns)).reshape(2, -1)
    matrix, k = opencv(corners, corners[:0])["at"]
    return {"matrix": matrix.tolist(), "k": k.ravel().tolist(), "board": np.stack([x, y, 0 * x], axis=1)}


def what_release_needs(corners: np.ndarray) -> list[dict]:
    """`cv2.calibrateCameraRO` on photos of one zoom, by its solver and the number of corners."""
    rows = []
    for step in (4, 3, 2, 1):
        part = corners[:, ::step, ::step]
        size = {"photos": len(part), "corners": part.shape[1] * part.shape[2]}
        for name, options in {
            "as it comes": {"lu": False, "no_schur": False},
            "no Schur complement": {"lu": False},
            "no Schur complement, LU": {},
        }.items():
            found = released(part, **options)
            keep = {key: found[key] for key in ("error", "seconds", "rms") if key in found}
            rows.append({"call": name, **size, **keep})
    return rows


def by_fixed_point(corners: np.ndarray, others: np.ndarray) -> list[dict]:
    """`cv2.calibrateCameraRO` with other points held, on one half of a zoom's photos."""
    rows, columns = corners.shape[1:3]
    out = []
    for name, fixed in {
        "last of the first row": columns - 1,
        "first of the last row": (rows - 1) * columns,
        "middle of the first row": columns // 2,
        "middle of the board": rows // 2 * columns + columns // 2,
        "second of the first row": 1,
    }.items():
        found = released(corners, fixed=fixed)
        row = {"fixed": name, "error": found.get("error")}
        if "matrix" in found:
            row |= {
                "focal": found["matrix"][0][0],
                "rms": found["rms"],
                "not_seen": rms(missed(found, others)),
                "seconds": found["seconds"],
            }
        out.append(row)
    return out


def run(data: Path) -> dict:
    """All measurements."""
    corners, zoom, _ = read_corners(data / "zoomcam")
    corners = corners.astype(float)
    first, longest = halves(zoom, np.random.default_rng(0)), zoom == zoom.max()
    results = {
        "zooms": np.unique(zoom).tolist(),
        "ours": ours(corners, zoom, first),
        "others": {
            "`cv2.calibrateCamera`": each(flat, corners, zoom, first),
            "`cv2.calibrateCameraRO`": each(released, corners, zoom, first),
            FREE: each(lambda part: released(part, free=True), corners, zoom, first),
        },
        "needs": what_release_needs(corners[first & longest]),
        "fixed": by_fixed_point(corners[first & longest], corners[~first & longest]),
        "opencv": cv2.__version__,
        "mrcal": None,
    }
    if python := python_with_mrcal():
        results["mrcal"] = version_of_mrcal()
        for name, options in MODELS.items():
            results["others"][name] = each(
                lambda part, given=options: asked(python, MRCAL, part, **given), corners, zoom, first
            )
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return results | {"children_seconds": spent.ru_utime + spent.ru_stime}


def number(x: float, form: str) -> str:
    """A figure, or a dash where there is none."""
    return format(x, form) if np.isfinite(x) else "-"


def page(r: dict) -> list[str]:
    """The results as a page."""
    labels = [f"{zoom:g}x" for zoom in r["zooms"]]
    fits = {"`fit_boards`": r["ours"]["pose"]} | r["others"]
    with_bend = {"`fit_boards`, bend of each photo refitted, too": r["ours"]["bend"]}
    release = r["others"]["`cv2.calibrateCameraRO`"]
    errors = sorted(
        {
            row["error"][row["error"].find("(-") :].splitlines()[0]
            for row in r["needs"]
            if shortened(row.get("error", "does not end")) == "an error"
        }
    )
    problems = [f"{name}: {error}." for name, of in r["others"].items() for error in of["errors"]]
    free = {name: of for name, of in r["others"].items() if "cv2" not in name or name == FREE}
    lost = {name: of["outliers"] for name, of in free.items() if of["outliers"]}
    return [
        "# Bent boards beside other programs",
        "",
        f"116 photos of a zoom camera, fitted half against half: the first pair of halves of "
        f"[boards.md](boards.md). Other programs take {r['children_seconds']:.0f} s of CPU time in all. "
        f"OpenCV {r['opencv']}; "
        + (
            "mrcal is not installed where this ran, and was left out."
            if r["mrcal"] is None
            else f"mrcal {r['mrcal']}."
        ),
        "",
        "## Photos not seen",
        "",
        "RMS distance of corners, px: lens and board as fitted, the pose of each photo refitted by least "
        f"squares. For that the lenses of `fit_boards` are written in OpenCV's form, within "
        f"{r['ours']['off']:.1g} px; with its own poses, of a robust loss, it is "
        f"{r['ours']['robust_pose']['not_seen']:.3f} px. The last row is another measure: there "
        "`fit_boards` also refits how the board bends in each photo, 12 numbers for 660, which the others "
        "cannot.",
        "",
        *table(
            ["fit", "all", *labels, "median"],
            (
                [
                    name,
                    *(number(x, ".3f") for x in (of["not_seen"], *of["not_seen_by_zoom"], of["median"])),
                ]
                for name, of in {**fits, **with_bend}.items()
            ),
        ),
        "",
        *([" ".join(problems), ""] if problems else []),
        "## Lens, half against half",
        "",
        "RMS difference of corrected corners, px: mean over the zooms, and each. In the last column, a "
        "mean, one half's corners are first moved by the homography that brings them nearest to the "
        "other's: what is left is how the lenses disagree about what is straight. The other columns also "
        "count that centres differ. `fit_boards` has one centre and one zoom model for all zooms.",
        "",
        *table(
            ["fit", "mean", *labels, "homography apart"],
            (
                [
                    name,
                    *(
                        number(x, ".3f")
                        for x in (np.mean(of["scatter"]), *of["scatter"], np.mean(of["scatter_bent"]))
                    ),
                ]
                for name, of in fits.items()
            ),
        ),
        "",
        "## Focal lengths",
        "",
        "Mean of both halves, px (of mrcal the geometric mean of both directions); how far halves are "
        "apart at most; and how far from a parabola in the logarithm of the zoom's label.",
        "",
        *table(
            ["fit", *labels, "apart, %", "off a curve, %"],
            (
                [
                    name,
                    *(number(x, ".0f") for x in of["focal"]),
                    number(100 * max(of["repeats"]), ".2f"),
                    number(100 * of["off_curve"], ".2f"),
                ]
                for name, of in fits.items()
            ),
        ),
        "",
        "mrcal's models free both focal lengths, the centre and two tangential terms at each zoom. Centres "
        "are found at y = "
        + "; ".join(f"{lowest(of):.0f} to {highest(of):.0f} px ({name})" for name, of in free.items())
        + f". Those of `fit_boards` are at {lowest(r['ours']['pose']):.0f} to "
        f"{highest(r['ours']['pose']):.0f} px."
        + "".join(f" {name} takes {count} of 38280 corners for outliers." for name, count in lost.items()),
        "",
        "## What `cv2.calibrateCameraRO` needs",
        "",
        f"Photos of {labels[-1]}, one half. *As it comes*: with the flags of `calibrateCamera`. *No Schur "
        "complement*: with `CALIB_DISABLE_SCHUR_COMPLEMENT`, and `CALIB_FIX_TAUX_TAUY`, because the same "
        "bit frees the sensor's tilt. *LU*: with `CALIB_USE_LU`, in place of singular values, of a matrix "
        f"with a row for each coordinate of each corner of the board. The limit is {LIMIT} s.",
        "",
        *table(
            ["call", "photos", "corners", "ends after, s", "RMS of the fit, px"],
            (
                [
                    row["call"],
                    str(row["photos"]),
                    str(row["corners"]),
                    f"{row['seconds']:.2f}" if "seconds" in row else shortened(row["error"]),
                    f"{row['rms']:.3f}" if "rms" in row else "-",
                ]
                for row in r["needs"]
            ),
        ),
        "",
        *(line for error in errors for line in (f"The error: `{error}`.", "")),
        f"All ten fits of the tables above: {release['seconds']:.0f} s, by LU. They start at "
        f"f = {FOCAL:.0f} px and have 30 steps, as `calibrateCamera`. At 1x that is too few for the lens "
        "as OPENCV4: started near the focal length of 1x, it gets there.",
        "",
        "Three corners hold the board: the first, the height of the last, and one that is chosen, which "
        "must not lie on a line with them. The same photos, with other corners chosen:",
        "",
        *table(
            ["held", "f, px", "RMS of the fit, px", "photos not seen, px", "seconds"],
            (
                [
                    row["fixed"],
                    *(
                        [shortened(row["error"]), "-", "-", "-"]
                        if row["error"]
                        else [
                            f"{row['focal']:.0f}",
                            f"{row['rms']:.3f}",
                            f"{row['not_seen']:.3f}",
                            f"{row['seconds']:.1f}",
                        ]
                    ),
                ]
                for row in r["fixed"]
            ),
        ),
    ]


def shortened(error: str) -> str:
    """An error that fits into a table."""
    return error if error.startswith("does not end") else "an error"


def lowest(of: dict) -> float:
    """Of the centres, y."""
    return min(y for half in of["centre"] for _, y in half)


def highest(of: dict) -> float:
    """Of the centres, y."""
    return max(y for half in of["centre"] for _, y in half)


if __name__ == "__main__":
    main(__doc__, "board_rivals", run, page)
