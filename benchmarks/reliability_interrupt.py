"""Commands interrupted at random moments: what is left of their results, and of the user's files.

Each command is run to its end, to know how long it takes and what it writes. Then, again and again in a
copy of the folder, it gets SIGINT, SIGTERM or SIGKILL at a moment drawn evenly over that time. Several are
tried at once, one a processor. Counted are runs after which

- lost: a file of the user's is not as it was;
- wrong: a file under its final name is not whole (of commands that write the same bytes each time: not
  those bytes); results are part old, part new; or, but for SIGKILL, something temporary is left;
- crashed: the exit status is none that belongs to the signal, or there is a traceback once the command
  has begun;
- hung: it, or a process that it began, is still there a minute later.

    python -m benchmarks.reliability_interrupt 200
"""

import argparse
import concurrent.futures
import contextlib
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import jax.numpy as jnp
import numpy as np
import psutil

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.demo import write_photos
from zoomjax.app.results_folder import LIST

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
PATIENCE = 60.0  # s

_MAIN = [
    sys.executable,
    "-c",
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # as in a terminal
    "from zoomjax.app.cli import main; main()",
]
_ENDS = {".json": b"}\n", ".html": b"</html>\n", ".jpg": b"\xff\xd9", ".png": b"IEND\xaeB`\x82"}


@dataclasses.dataclass
class Command:
    """A command in a folder of its own.

    Attributes:
        name: what it is called in the results.
        arguments: of the command line.
        folder: with the user's files, then with the results of a run to its end beside them.
        together: whether all its results appear at once, so that there are all or none.
        again: whether it replaces its own results unasked, and so is tried over them, too.
        same: whether it writes the same bytes each time.
        seconds: that the run to its end took.
        users: the user's files and what they hold.
        results: what the run to its end wrote.
    """

    name: str
    arguments: list[str]
    folder: Path
    together: bool = True
    again: bool = True
    same: bool = True
    seconds: float = 0.0
    users: dict[str, bytes] = dataclasses.field(default_factory=dict)
    results: dict[str, bytes] = dataclasses.field(default_factory=dict)

    def prepare(self, environment: dict[str, str]) -> None:
        """Run it to its end, twice: the second time nothing is compiled."""
        (self.folder / "out" / "lines").mkdir(parents=True)
        for name in ("out/notes.txt", "out/lines/notes.txt", "out/photo.jpg"):
            (self.folder / name).write_text("the user's own")
        self.users = _contents(self.folder)
        for _ in range(2):
            for name in set(_contents(self.folder)) - set(self.users):
                (self.folder / name).unlink()
            start = time.monotonic()
            done = subprocess.run(
                [*_MAIN, *self.arguments], cwd=self.folder, env=environment, capture_output=True, text=True
            )
            self.seconds = time.monotonic() - start
            assert done.returncode == 0, done.stderr
        now = _contents(self.folder)
        self.results = {name: content for name, content in now.items() if name not in self.users}
        assert self.results


def _lines(folder: Path) -> Command:
    lines = scenes.board_lines(scenes.nikkor_18_200(), scenes.focal_sweep(5), spacing=60, noise=0.3)
    lines.save(folder / "lines.npz")
    return Command("calibrate, lines", ["calibrate", "lines.npz", "-o", "out"], folder, same=False)


def _photos(folder: Path) -> Command:
    write_photos(folder / "photos", number=3, image_size=(536, 356))
    arguments = ["calibrate", "photos", "-o", "out", "--degree", "1", "--jobs", "2", "--no-cache"]
    return Command("calibrate, photos", arguments, folder, same=False)


def _undistort(folder: Path) -> Command:
    write_photos(folder / "photos", number=3, image_size=(536, 356))
    scenes.nikkor_18_200().save(folder / "lens.json")
    arguments = ["undistort", "lens.json", "photos", "-o", "out/corrected"]
    return Command("undistort, photos", arguments, folder, together=False, again=False)


def _video(folder: Path) -> Command:
    scenes.nikkor_18_200((320, 214)).save(folder / "lens.json")
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (214, 320, 3)).astype(np.float32), (0, 0), 2)
    _write_clip(folder / "clip.mp4", (np.roll(image, number, 1).astype(np.uint8) for number in range(60)))
    arguments = ["undistort", "lens.json", "clip.mp4", "-o", "out/corrected.mp4", "--focal", "24"]
    return Command("undistort, video", arguments, folder, again=False, same=False)


def _write_clip(path: Path, images: Iterable[np.ndarray]) -> None:
    with av.open(str(path), "w") as out:
        video: Any = None
        for image in images:
            if video is None:
                video = out.add_stream("libx264", rate=30)
                video.height, video.width = image.shape[:2]
                video.pix_fmt = "yuv420p"
            frame = av.VideoFrame.from_ndarray(image, "bgr24")
            out.mux(video.encode(frame.reformat(format="yuv420p")))
        out.mux(video.encode(None))


def _clip(folder: Path) -> Command:
    coeffs = jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.1, 0.03]])
    zoom = zj.PolynomialZoom(2, coeffs, jnp.array(500.0))
    lens = zj.ZoomLens(zoom, jnp.array([322.0, 178.0]), jnp.array([500.0, 1200.0]), (640, 360), "px")
    path = scenes.pan_and_zoom(lens, 36, pan=20, tilt=5)
    _write_clip(folder / "clip.mp4", scenes.motion_clip(lens, *path, noise=2).frames())
    arguments = ["calibrate", "clip.mp4", "-o", "out", "--focal", "motion", "--degree", "1"]
    return Command("calibrate, clip", arguments, folder, same=False)


def _demo(folder: Path) -> Command:
    return Command("demo", ["demo", "-o", "out", "--photos", "3"], folder, same=False)


def _lens(folder: Path) -> Command:
    return Command("lens", ["lens", "nikkor 18-200 ii", "-o", "out"], folder, again=False, same=False)


def _export(folder: Path) -> Command:
    scenes.nikkor_18_200().save(folder / "lens.json")
    arguments = ["export", "lens.json", "--to", "opencv", "-o", "out/opencv", "--focal", "24,35,50,85"]
    return Command("export", [*arguments, "--pixel-pitch", "0.0055"], folder, again=False)


def _stmap(folder: Path) -> Command:
    scenes.nikkor_18_200((160, 107)).save(folder / "lens.json")
    arguments = ["export", "lens.json", "--to", "stmap", "-o", "out/maps", "--focal", "24,35,50,85"]
    return Command("export, STMaps", arguments, folder, again=False)


def _import(folder: Path) -> Command:
    zj.interop.write(
        scenes.nikkor_18_200(), folder / "lens.xml", format="lensfun", pixel_pitch=0.0055, tolerance=1.0
    )
    arguments = ["import", "lens.xml", "-o", "out", "--image-size", "1072x712"]
    return Command("import", arguments, folder, same=False)


COMMANDS = {
    "lines": _lines,
    "photos": _photos,
    "clip": _clip,
    "demo": _demo,
    "undistort": _undistort,
    "video": _video,
    "export": _export,
    "stmap": _stmap,
    "import": _import,
    "lens": _lens,
}
"""What makes each command, with its files, in an empty folder."""


def run(count: int, seed: int, names: tuple[str, ...] = tuple(COMMANDS)) -> dict[str, dict]:
    """So many interrupted runs of each command.

    Returns:
        For each command: how many were tried, wrong, lost, crashed, hung; and what was seen of those.
    """
    return {command.name: found for command, found in _each(count, seed, names)}


def _each(count: int, seed: int, names: tuple[str, ...]) -> Iterator[tuple[Command, dict]]:
    with tempfile.TemporaryDirectory(prefix="zoomjax-interrupt-") as name:
        folder = Path(name)
        environment = os.environ | {"ZOOMJAX_CACHE": str(folder / "cache")}
        for name in names:
            (own := folder / name).mkdir()
            command = COMMANDS[name](own)
            command.prepare(environment)
            yield command, _interrupted(command, count, seed, folder, environment)


def _interrupted(
    command: Command, count: int, seed: int, folder: Path, environment: dict[str, str]
) -> dict[str, Any]:
    """So many runs of one command."""
    rng = np.random.default_rng(seed)
    found: dict = {"tried": 0, "wrong": 0, "lost": 0, "crashed": 0, "hung": 0, "finished": 0, "seen": []}

    def trial(number: int, kind: signal.Signals, again: bool, moment: float) -> list[tuple[str, str]]:
        told = _trial(command, folder / f"trial{number}", environment, kind, moment, again)
        return [(what, f"{kind.name} after {moment:.2f} s: {what}: {text}") for what, text in told]

    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        trials = []
        for number in range(count):
            kind = SIGNALS[int(rng.integers(len(SIGNALS)))]
            again = bool(rng.integers(2)) and command.again  # over earlier results
            moment = float(rng.uniform(0, command.seconds))
            trials.append(pool.submit(trial, number, kind, again, moment))
        for result in trials:
            found["tried"] += 1
            for what, told in result.result():
                found[what] += 1
                if what != "finished":
                    found["seen"].append(told)
    return found


def _trial(
    command: Command,
    folder: Path,
    environment: dict[str, str],
    kind: signal.Signals,
    moment: float,
    again: bool,
) -> list[tuple[str, str]]:
    """One run; what was wrong with it, each kind once."""
    shutil.copytree(command.folder, folder)
    if not again:
        for name in command.results:
            (folder / name).unlink()
    process = subprocess.Popen(
        [*_MAIN, *command.arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    found: dict[str, str] = {}
    try:
        time.sleep(moment)
        others = _children(process.pid)
        process.send_signal(kind)
        try:
            stderr = process.communicate(timeout=PATIENCE)[1].decode(errors="replace")
        except subprocess.TimeoutExpired:
            found["hung"] = "the command"
            process.kill()
            stderr = process.communicate()[1].decode(errors="replace")
        _, left = psutil.wait_procs(others, timeout=PATIENCE)
        for other in left:
            found["hung"] = f"process {' '.join(other.cmdline())[:100]}"
            other.kill()
        status = process.returncode
        if status == 0:
            found["finished"] = ""
        elif status not in (-kind, 128 + kind) and "hung" not in found:
            found["crashed"] = f"exit status {status}: {stderr[-300:]}"
        elif "Traceback" in stderr and ", in main\n" in stderr:
            found["crashed"] = stderr[-300:]
        new = _contents(folder)
        if changed := [name for name, content in command.users.items() if new.get(name) != content]:
            found["lost"] = ", ".join(changed)
        if wrong := _wrong(command, folder, new, killed=kind == signal.SIGKILL):
            found["wrong"] = wrong
    finally:
        shutil.rmtree(folder)
    return list(found.items())


def _wrong(command: Command, folder: Path, new: dict[str, bytes], *, killed: bool) -> str:
    """What is wrong with the results; empty if nothing is."""
    results = {name for name in new if name not in command.users and "/.zoomjax-" not in f"/{name}"}
    for name in results - {f"out/{LIST}"}:
        if not _whole(command, name, folder / name, new[name]):
            return f"{name} is half"
    temporary = [name for name in new if "/.zoomjax-" in f"/{name}"]
    if temporary and not killed:
        return f"{temporary[0]} is left"
    if not command.together or killed:
        return ""
    if results and results != set(command.results):
        return f"there are {len(results)} of {len(command.results)} files"
    if f"out/{LIST}" in results:
        listed = json.loads(new[f"out/{LIST}"])["files"]
        if any(len(prints) > 1 for prints in listed.values()):
            return "old and new results are mixed"
    return ""


def _whole(command: Command, name: str, path: Path, content: bytes) -> bool:
    """Whether a result is all there."""
    if command.same:
        return content == command.results.get(name)
    if path.suffix == ".npz":
        np.load(path, allow_pickle=False)["points"]
    if path.suffix == ".mp4":
        with av.open(str(path)) as video:
            return sum(1 for _ in video.decode(video=0)) == 60
    return content.endswith(_ENDS.get(path.suffix, b""))


def _children(pid: int) -> list[psutil.Process]:
    with contextlib.suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).children(recursive=True)
    return []


def _contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    given = parser.parse_args()
    for command, found in _each(given.count, given.seed, tuple(given.command)):
        print(f"{command.name}, {command.seconds:.1f} s:", json.dumps(found, indent=2), flush=True)
