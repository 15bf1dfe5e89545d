"""The Python and shell blocks of README and docs, run as they stand on one small data set."""

import importlib.util
import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import av
import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from sybil import Sybil
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser

import zoomjax as zj
from docs.make.tables import ROOT, pages
from zoomjax import scenes
from zoomjax.app.calibrating import calibrate
from zoomjax.app.demo import write_photos
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.undistort_files import Job, undistort_files

from ._commands import SEVERAL

SIZE = (1072, 712)
FOCAL = (20.56, 30.94, 41.38, 62.46, 127.36)
TURNING = 24  # frames
PAGES = {str(page.relative_to(ROOT)): page for page in pages()}


def without_torch(example):
    if importlib.util.find_spec("torch"):
        exec(compile(example.parsed, example.path, "exec"), example.namespace)


def nothing(example):
    """Shell commands are run one by one, below."""


PYTHON = Sybil([PythonCodeBlockParser(), CodeBlockParser("python torch", without_torch)])
SHELL = Sybil([CodeBlockParser("sh", nothing)])


def shell_lines(page):
    for example in SHELL.parse(page).examples():
        lines = example.parsed.splitlines()
        yield from (line.partition("  #")[0].strip() for line in lines if line and line[0] != "#")


COMMANDS = {name: list(shell_lines(page)) for name, page in PAGES.items()}
OURS = {line for lines in COMMANDS.values() for line in lines if line.startswith("zoomjax ")}
IN_CI = sorted(
    line
    for line in OURS & set(COMMANDS["README.md"])
    if line.startswith(("zoomjax undistort", "zoomjax calibrate lines.csv"))
)
"""A calibration compiles for most of a minute; CI runs that of photos as `zoomjax demo`."""
ON_A_CLUSTER = sorted(line for line in OURS if "--cluster" in line)
OF_A_BOARD = sorted(line for line in OURS if "--known-focal p" in line)
"""Their clip shows a board, or a pitch, in a scene that can be followed: one is in `app/test_clips`."""
OTHERS = sorted(OURS - {*IN_CI, *ON_A_CLUSTER, *OF_A_BOARD})
ADDRESS = "tcp://192.168.0.5:8786"  # of a scheduler, as pages have it
ELSEWHERE = "s3://bucket", "https://example.org"  # where pages have files


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """What a user has: photos, views of a grid, clips and their tracks, lines, and a lens."""
    folder = tmp_path_factory.mktemp("given")
    photos = write_photos(folder / "photos", number=5, image_size=SIZE)
    names = [photo.name for photo in photos]
    table(folder / "focal.csv", "image,focal", zip(names, FOCAL, strict=True))
    write_clip(folder / "clip.mp4", [cv2.imread(str(photo))[..., ::-1] for photo in photos])
    table(folder / "track.csv", "frame,focal", enumerate(FOCAL))
    write_clip(folder / "match.mp4", pitch_frames())
    (folder / "match").mkdir()
    for number, frame in enumerate(pitch_frames()):
        cv2.imwrite(str(folder / "match" / f"{number}.png"), frame[..., ::-1])
    for place, name in (("clips", "clip.mp4"), ("tracks", "track.csv")):
        (folder / place).mkdir()
        shutil.copy(folder / name, (folder / place / "clip").with_suffix(Path(name).suffix))
    shutil.copytree(folder / "photos", folder / "shoot" / "day1")
    shutil.make_archive(str(folder / "photos"), "zip", folder, "photos")
    with Image.open(photos[0]) as photo:
        photo.save(folder / "plate.tif", exif=photo.getexif())
    write_clip(folder / "turning.mp4", turning_frames())
    write_clip(folder / "still.mp4", turning_frames(pan=0, tilt=0))
    (folder / "views").mkdir()
    for f, *views in zip(FOCAL, grid_views(), grid_views(0.5), strict=True):
        cv2.imwrite(str(folder / "views" / f"{FOCAL.index(f)}.png"), views[0])
        zoom = folder / "zoom" / f"{f:.0f}mm"
        zoom.mkdir(parents=True)
        for number, view in enumerate(views):
            cv2.imwrite(str(zoom / f"{number}.png"), view)
    table(folder / "views.csv", "image,focal", ((f"{n}.png", f) for n, f in enumerate(FOCAL)))
    straight_lines_bent(folder / "lines.csv")
    table(folder / "frames.csv", "frame,focal", enumerate((24, 50, 80, 105)))
    calibrate(board(), model=WantedModel("polynomial"), centre=None).write(folder / "mylens")
    overscan = Job(
        folder / "mylens" / "lens.json", (folder / "plate.tif",), folder / "render.tif", keep="grow"
    )
    undistort_files(overscan)
    table(folder / "mylens" / "track.csv", "frame,focal", enumerate(np.geomspace(24, 105, TURNING)))
    lens = scenes.nikkor_18_200((4288, 2848))
    zj.interop.write(lens, folder / "zoom.xml", format="lensfun", pixel_pitch=0.0055)
    return folder


def table(path, head, rows):
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")


def write_clip(path, frames):
    with av.open(str(path), "w") as out:
        video = out.add_stream("libx264", rate=25, options={"crf": "6", "preset": "veryfast"})
        video.height, video.width = frames[0].shape[:2]
        video.pix_fmt = "yuv420p"
        for frame in frames:
            out.mux(video.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), "rgb24")))
        out.mux(video.encode(None))


def board():
    lens = scenes.nikkor_18_200(SIZE)
    return scenes.board_lines(lens, np.array(FOCAL), spacing=20.0, noise=0.2)


def straight_lines_bent(path):
    t = np.linspace(0, 479, 60)
    rows = [
        (frame, line, x + 200 / f * (x / 320 - 1) * (y / 240 - 1) ** 2, y)
        for frame, f in enumerate((24, 50, 80, 105))
        for line, x in enumerate(range(20, 640, 54))
        for y in t
    ]
    table(path, "frame,line,x,y", rows)


def pitch_frames():
    lens = scenes.broadcast_zoom()
    focal = np.linspace(*np.asarray(lens.focal_range), len(FOCAL))
    lines = scenes.broadcast_lines(lens, focal)
    grass = np.full((*lens.image_size[::-1], 3), (60, 130, 50), np.uint8)
    frames = [grass.copy() for _ in focal]
    for points, frame in zip(lines.to_ragged(), np.asarray(lines.frame), strict=True):
        fixed = np.rint(points * 16).astype(np.int32)
        cv2.polylines(frames[frame], [fixed], False, (250,) * 3, 6, cv2.LINE_AA, 4)
    return frames


def turning_frames(**angles):
    """What a camera sees that zooms and turns, by 20 degrees if nothing else is said."""
    size, focal = (536, 356), jnp.array([400.0, 900.0])
    zoom = zj.PolynomialZoom(1, jnp.array([[0.0, 0.0], [-0.1, 0.02]]), focal[0])
    lens = zj.ZoomLens(zoom, (jnp.array(size) - 1) / 2, focal, size, "px")
    clip = scenes.motion_clip(lens, *scenes.pan_and_zoom(lens, TURNING, **{"pan": 20} | angles))
    return [frame[..., ::-1] for frame in clip.frames()]


def grid_views(least=0.35):
    """A checkerboard seen obliquely, at five focal lengths, turned by so many radians at least."""
    squares = np.kron(np.indices((9, 12)).sum(0) % 2, np.ones((40, 40))).astype(np.uint8) * 200 + 30
    corners = np.array([[0, 0], [480, 0], [480, 360], [0, 360]], np.float32)
    for number, f in enumerate(FOCAL):
        angle = least + 0.05 * number
        x, y = ((corners - [240, 180]) / 100).T
        depth = 8 + np.sin(angle) * (x + 0.6 * y)
        seen = 150 * f**0.5 * np.stack([np.cos(angle) * x, np.cos(0.6 * angle) * y]).T / depth[:, None]
        place = cv2.getPerspectiveTransform(corners, (seen + np.array([536, 356])).astype(np.float32))
        yield cv2.warpPerspective(squares, place, SIZE, flags=cv2.INTER_AREA, borderValue=255)


@pytest.fixture
def here(given, tmp_path, monkeypatch):
    """A copy of it to work in."""
    shutil.copytree(given, tmp_path / "work", copy_function=os.link)
    monkeypatch.chdir(tmp_path / "work")
    return Path.cwd()


def beams():
    """A bright beam in each image, bent a little."""
    images = np.zeros((len(FOCAL), 480, 640), np.uint8)
    for image, f in zip(images, FOCAL, strict=True):
        for y in range(480):
            x = 500 + 40 / f * (y / 240 - 1) ** 2
            image[y, int(x) : int(x) + 2] = [255 * (1 - x % 1), 255 * (x % 1)]
    return list(images)


@pytest.fixture(scope="module")
def names():
    """What the blocks take as given: a small data set, its fit, and what a reader would call the rest."""
    lines = board()
    small = zj.compress(lines, terms=3)
    fit = zj.fit_zoom(small, terms=2)
    lens = fit.lens
    common = {"np": np, "jnp": jnp, "zj": zj, "lines": lines, "small": small, "fit": fit, "lens": lens}
    common |= {"exact_lines": lines, "point": np.array([10.0, 20.0]), "points": np.array([[10.0, 20.0]])}
    common |= {"focals": np.array([24.0, 35.0]), "image": np.zeros(SIZE[::-1], np.uint8)}
    common |= {"w": 400, "h": 300, "x": 200, "y": 150, "d": lens(35.0)}
    return {
        None: common,
        "docs/embedding.md": {},
        "README.md": {},
        "docs/detection.md": {"zj": zj, "image": cv2.GaussianBlur(next(grid_views()), None, 0.7)}
        | {"images": beams(), "focal": np.array(FOCAL)},
        "docs/zoom-models.md": common | focused(),
    }


def focused():
    """Lines at several focuses, in the variables of Lines.from_ragged."""
    ragged, frame = [], []
    distance = np.repeat([1.0, 2.0, 5.0], 3)
    focal = np.tile([24.0, 50.0, 100.0], 3)
    t = np.linspace(0, 479, 40)
    for number, (f, d) in enumerate(zip(focal, distance, strict=True)):
        for x in range(20, 640, 54):
            bend = (200 / f + 2 / d) * (x / 320 - 1) * (t / 240 - 1) ** 2
            ragged.append(np.stack([x + bend, t], axis=-1))
            frame.append(number)
    return {
        "points": ragged,
        "frame": frame,
        "focal": focal,
        "distance": distance,
        "w": 640,
        "h": 480,
        "point": jnp.zeros(2),
    }


WITH_PYTHON = [
    pytest.param(name, marks=[] if name == "README.md" else pytest.mark.slow)
    for name, page in PAGES.items()
    if list(PYTHON.parse(page).examples())
]


@pytest.mark.parametrize("name", WITH_PYTHON)
def test_python_blocks_run(name, names, here):
    document = PYTHON.parse(PAGES[name])
    document.namespace.update(names.get(name, names[None]))
    for example in document.examples():
        example.evaluate()


def ran(lines, given, folders):
    """The status and the words of each command, and what it should have made.

    The shell takes the commands apart; one process runs them all.
    """
    jobs = {}
    for named in lines:
        line, folder = named, folders.mktemp("command") / "work"
        shutil.copytree(given, folder, copy_function=os.link)
        for place in ELSEWHERE:
            line = line.replace(place, folder.as_uri())
        apart = subprocess.run(
            ["sh", "-c", f"printf '%s\\n' {line}"], cwd=folder, capture_output=True, text=True, check=True
        )
        words = apart.stdout.splitlines()
        target = folder / words[words.index("-o") + 1]
        shutil.rmtree(target, ignore_errors=True)
        target.unlink(missing_ok=True)
        jobs[named] = str(folder), words
    done = subprocess.run(
        [sys.executable, "-c", SEVERAL],
        input=json.dumps(list(jobs.values())),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    made = [Path(folder) / words[words.index("-o") + 1] for folder, words in jobs.values()]
    return {line: (*one, path) for line, one, path in zip(jobs, told, made, strict=True)}


@pytest.fixture(scope="module")
def in_ci(given, tmp_path_factory):
    return ran(IN_CI, given, tmp_path_factory)


@pytest.fixture(scope="module")
def others(given, tmp_path_factory):
    return ran(OTHERS, given, tmp_path_factory)


@pytest.fixture(scope="module")
def on_a_cluster(given, tmp_path_factory):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        own = [line.replace(ADDRESS, cluster.scheduler_address) for line in ON_A_CLUSTER]
        return dict(zip(ON_A_CLUSTER, ran(own, given, tmp_path_factory).values(), strict=True))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # what Dask and Tornado warn of
@pytest.mark.parametrize("line", ON_A_CLUSTER)
def test_commands_run_on_a_cluster(line, on_a_cluster):
    status, said, made = on_a_cluster[line]
    assert status == 0, said
    assert made.exists()
    assert "2 workers" in said


@pytest.mark.slow
@pytest.mark.parametrize("line", IN_CI)
def test_shell_commands_run(line, in_ci):
    status, said, made = in_ci[line]
    assert status == 0, said
    assert made.exists()


@pytest.mark.exhaustive
@pytest.mark.parametrize("line", OTHERS)
def test_all_other_shell_commands_run(line, others):
    status, said, made = others[line]
    assert status == 0, said
    assert made.exists()


def test_other_commands_are_those_that_set_up_and_check():
    """They install packages and run all tests: .ci/run runs them itself."""
    first = ("python3 -m venv .venv", ".venv/bin/pip install", ".venv/bin/pre-commit install")
    first += (".venv/bin/python -m pytest", ".venv/bin/python -m docs.make", "pip install")
    first += ("dask scheduler", "dask worker")
    others = {line for lines in COMMANDS.values() for line in lines} - OURS
    assert all(line.startswith(first) for line in others), others
    for line in others:
        for word in shlex.split(line):
            if word.startswith("tests/"):
                assert (ROOT / word).exists()
