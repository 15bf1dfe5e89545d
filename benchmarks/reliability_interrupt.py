"""Commands interrupted at random moments: what is left of their results, and of the user's files.

Each command is run to its end, to know how long it takes and what it writes. Then, again and again in a
copy of the folder, it gets SIGINT, SIGTERM or SIGKILL at a moment drawn evenly over that time. Counted are
runs after which

- lost: a file of the user's is not as it was;
- wrong: a file under its final name is not whole; results are part old, part new; or, but for SIGKILL,
  something temporary is left;
- crashed: the exit status is none that belongs to the signal, or there is a traceback once the command
  has begun;
- hung: it, or a process that it began, is still there a minute later.

    python -m benchmarks.reliability_interrupt 200
"""

import argparse
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
from pathlib import Path

import numpy as np
import psutil

from zoomjax import scenes
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
        seconds: that this took.
        users: the user's files and what they hold.
    """

    name: str
    arguments: list[str]
    folder: Path
    seconds: float = 0.0
    users: dict[str, bytes] = dataclasses.field(default_factory=dict)

    def prepare(self, environment: dict[str, str]) -> None:
        """Run it to its end, twice: the second time nothing is compiled."""
        (self.folder / "out" / "lines").mkdir(parents=True)
        for name in ("out/notes.txt", "out/lines/notes.txt", "out/photo.jpg"):
            (self.folder / name).write_text("the user's own")
        self.users = _contents(self.folder)
        for _ in range(2):
            if self.name == "undistort":
                shutil.rmtree(self.folder / "out" / "corrected", ignore_errors=True)
            start = time.monotonic()
            done = subprocess.run(
                [*_MAIN, *self.arguments], cwd=self.folder, env=environment, capture_output=True, text=True
            )
            self.seconds = time.monotonic() - start
            assert done.returncode == 0, done.stderr


def commands(folder: Path, names: tuple[str, ...]) -> list[Command]:
    """The commands of these names, each with its files."""
    made = []
    for name in names:
        (own := folder / name).mkdir()
        lens = scenes.nikkor_18_200()
        if name == "lines":
            lines = scenes.board_lines(lens, scenes.focal_sweep(5), spacing=60, noise=0.3)
            lines.save(own / "lines.npz")
            arguments = ["calibrate", "lines.npz", "-o", "out"]
        else:
            from zoomjax.app.demo import write_photos

            write_photos(own / "photos", number=3, image_size=(536, 356))
            arguments = ["calibrate", "photos", "-o", "out", "--degree", "1", "--jobs", "2", "--no-cache"]
            if name == "undistort":
                lens.save(own / "lens.json")
                photos = sorted(f"photos/{path.name}" for path in (own / "photos").iterdir())
                arguments = ["undistort", "lens.json", *photos, "-o", "out/corrected"]
        made.append(Command(name, arguments, own))
    return made


def run(count: int, seed: int, names: tuple[str, ...] = ("lines", "lines", "undistort", "photos")) -> dict:
    """So many interrupted runs of the commands, in turn.

    Returns:
        How many were tried, wrong, lost, crashed, hung; and what was seen of those that were.
    """
    rng = np.random.default_rng(seed)
    found: dict = {"tried": 0, "wrong": 0, "lost": 0, "crashed": 0, "hung": 0, "finished": 0, "seen": []}
    with tempfile.TemporaryDirectory(prefix="zoomjax-interrupt-") as folder:
        environment = os.environ | {"ZOOMJAX_CACHE": str(Path(folder) / "cache")}
        made = {command.name: command for command in commands(Path(folder), tuple(dict.fromkeys(names)))}
        for command in made.values():
            command.prepare(environment)
        for number in range(count):
            command = made[names[number % len(names)]]
            kind = SIGNALS[int(rng.integers(len(SIGNALS)))]
            again = bool(rng.integers(2)) and command.name != "undistort"  # over earlier results
            moment = float(rng.uniform(0, command.seconds))
            outcome = _trial(command, Path(folder) / "trial", environment, kind, moment, again)
            found["tried"] += 1
            for what, told in outcome:
                found[what] += 1
                if what != "finished":
                    found["seen"].append(
                        f"{command.name}, {kind.name} after {moment:.2f} s: {what}: {told}"
                    )
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
        for name in set(_contents(folder)) - set(command.users):
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
        if not new[name].endswith(_ENDS.get(Path(name).suffix, b"")):
            return f"{name} is half"
        if name.endswith(".npz"):
            np.load(folder / name, allow_pickle=False)["points"]
    temporary = [name for name in new if "/.zoomjax-" in f"/{name}"]
    if temporary and not killed:
        return f"{temporary[0]} is left"
    if command.name == "undistort":
        return ""  # each photo is a result of its own
    expected = {name for name in _contents(command.folder) if name not in command.users}
    if results and results != expected and not killed:
        return f"there are {len(results)} of {len(expected)} files"
    if results and not killed:
        listed = json.loads(new[f"out/{LIST}"])["files"]
        if any(len(prints) > 1 for prints in listed.values()):
            return "old and new results are mixed"
    return ""


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
    given = parser.parse_args()
    print(json.dumps(run(given.count, given.seed), indent=2))
