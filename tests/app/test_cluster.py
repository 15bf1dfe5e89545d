"""Photos and clips on a cluster of Dask: the same results, also when a worker dies in the middle."""

import os
import signal
import socket
import subprocess
import sys
import threading

import numpy as np
import pytest

import zoomjax as zj
from zoomjax.app import cluster as module
from zoomjax.app import demo
from zoomjax.app.cluster import cluster_executor
from zoomjax.app.undistort_files import Job, undistort_files
from zoomjax.detect import EdgeDetector, detect, find_photos
from zoomjax.io.video_reader import decode_video

from .._clips import lens, write_frames
from .._commands import COMMAND

distributed = pytest.importorskip("distributed")

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # what Dask and Tornado warn of

SIZE = (536, 356)


@pytest.fixture(scope="module")
def address():
    """That of a scheduler with two workers, each a process."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    demo.write_photos(folder, number=6, image_size=SIZE)
    (folder / "cut.jpg").write_bytes(next(folder.glob("*.jpg")).read_bytes()[:5000])
    return folder


def processes(address):
    with distributed.Client(address, set_as_default=False) as client:
        return list(client.run(os.getpid).values())


def same_lines(found, expected):
    assert [d.problem for d in found] == [d.problem for d in expected]
    for one, other in zip(found, expected, strict=True):
        for line, same in zip(one.lines, other.lines, strict=True):
            np.testing.assert_array_equal(line, same)


def test_lines_are_those_found_here_though_a_worker_is_killed(address, photos):
    expected = list(detect(find_photos([photos]), EdgeDetector()))
    before = processes(address)
    with cluster_executor(address, quiet=True) as executor:
        found = []
        for detection in detect(find_photos([photos]) * 4, EdgeDetector(), executor=executor):
            if not found:
                os.kill(before[0], signal.SIGKILL)
            found.append(detection)
    same_lines(found, expected * 4)
    assert before[0] not in processes(address)


def calibrated(photos, output, *options):
    words = ["calibrate", str(photos), "-o", str(output), "--degree", "1", "--centre", "image"]
    return subprocess.run(
        [*COMMAND, *words, "--no-cache", *options], capture_output=True, text=True, check=False
    )


def test_the_command_gives_the_same_files_on_a_cluster(address, photos, tmp_path):
    for name, options in (("here", ["--jobs", "1"]), ("there", ["--cluster", address])):
        done = calibrated(photos, tmp_path / name, *options)
        assert done.returncode == 0, done.stderr
    assert f"{address}: 2 workers" in done.stderr
    one, other = (np.load(tmp_path / name / "lines.npz") for name in ("here", "there"))
    assert set(one.files) == set(other.files)
    for name in one.files:
        np.testing.assert_array_equal(one[name], other[name])
    same = [(tmp_path / name / "lens.json").read_bytes() for name in ("here", "there")]
    assert same[0] == same[1]


def test_photos_are_corrected_to_the_last_byte_as_here(address, photos, tmp_path):
    zj.scenes.nikkor_18_200(SIZE).save(tmp_path / "lens.json")
    outcomes = []
    for name, place in (("here", None), ("there", address)):
        job = Job(tmp_path / "lens.json", (photos,), tmp_path / name, keep="valid")
        with cluster_executor(place, quiet=True) as executor:
            outcomes.append(undistort_files(job, executor=executor))
    assert outcomes[0].written == outcomes[1].written == 6
    assert list(outcomes[0].skipped.values()) == list(outcomes[1].skipped.values())
    names = sorted(path.name for path in (tmp_path / "here").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "there").iterdir())
    for name in names:
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes()


def test_what_a_worker_warns_of_is_said_here_once(address, photos, tmp_path):
    zj.scenes.nikkor_18_200((1072, 712)).save(tmp_path / "lens.json")
    job = Job(tmp_path / "lens.json", (photos,), tmp_path / "out")
    with (
        cluster_executor(address, quiet=True) as executor,
        pytest.warns(UserWarning, match="its distortion is scaled") as told,
    ):
        undistort_files(job, executor=executor)
    assert len([each for each in told if "scaled" in str(each.message)]) == 1


def test_a_clip_is_corrected_by_segments_though_a_worker_is_killed(address, tmp_path):
    rows = np.arange(192)[:, None, None] + np.zeros((1, 320, 3), int)
    frames = (((rows + number) % 192).astype(np.uint8) for number in range(400))
    write_frames(tmp_path / "in.mp4", frames, options={"g": "100", "preset": "ultrafast"})
    lens().save(tmp_path / "lens.json")
    killed, steps = [], []

    def kill(done, total):
        steps.append(done)
        if not killed:
            killed.append(processes(address)[0])
            os.kill(killed[0], signal.SIGKILL)

    pictures = []
    for name, place, progress in (("here", None, lambda done, total: None), ("there", address, kill)):
        job = Job(tmp_path / "lens.json", (tmp_path / "in.mp4",), tmp_path / f"{name}.mp4", focal="20")
        with cluster_executor(place, quiet=True) as executor:
            undistort_files(job, progress, executor)
        with decode_video(tmp_path / f"{name}.mp4") as (_, frames):
            pictures.append(np.stack([image() for _, _, image in frames]).astype(int))
    assert killed
    assert steps == [100, 200, 300, 400]
    assert len(pictures[0]) == len(pictures[1]) == 400
    assert np.abs(pictures[0] - pictures[1]).mean() < 1


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense:xx", "nowhere.invalid:8786"])
def test_a_scheduler_that_does_not_answer_is_one_sentence(address, photos, tmp_path):
    done = calibrated(photos, tmp_path / "out", "--cluster", address)
    assert done.returncode == 2
    assert done.stderr == (
        f"Error: --cluster is '{address}', but no scheduler of Dask answers there: give the address that "
        "it prints when it starts, such as tcp://192.168.0.5:8786.\n"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("says", [b"", b"SSH-2.0-OpenSSH_9.2\r\n", b"\1\0"])
def test_what_is_no_scheduler_is_not_waited_for(says, monkeypatch):
    monkeypatch.setattr(module, "_SECONDS", 1)
    with socket.create_server(("127.0.0.1", 0)) as server:
        answers = threading.Thread(target=lambda: (opened := server.accept()[0]).sendall(says) or opened)
        answers.start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(ConnectionError, match="no scheduler of Dask answers there"):
            module.cluster_executor(address, quiet=True).__enter__()
        answers.join()


@pytest.mark.parametrize("scheme", ["tls", "ucx", "xyz"])
def test_a_way_that_dask_does_not_take_is_one_sentence(address, scheme):
    with pytest.raises(ConnectionError, match="no scheduler of Dask answers there"):
        module.cluster_executor(address.replace("tcp", scheme), quiet=True).__enter__()


def looked_at(photos, address):
    with cluster_executor(address, quiet=True) as executor:
        return list(detect(find_photos([photos]), EdgeDetector(), executor=executor))


def test_a_scheduler_that_goes_away_is_one_sentence(photos, capfd):
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    with subprocess.Popen([*command, "--no-dashboard"], stderr=subprocess.PIPE, text=True) as scheduler:
        address = next(line.split()[-1] for line in scheduler.stderr or () if "Scheduler at:" in line)
        threading.Timer(3, scheduler.kill).start()  # without workers, nothing is done before
        with pytest.raises(ConnectionError, match=f"The scheduler of Dask at {address} has gone away"):
            looked_at(photos, address)
    assert "Traceback" not in capfd.readouterr().err


def test_options_without_effect_are_refused(photos, tmp_path):
    done = calibrated(photos, tmp_path / "out", "--cluster", "tcp://a:1", "--jobs", "2")
    assert done.returncode == 2
    assert "--jobs has no effect with --cluster" in done.stderr


def test_workers_of_another_version_are_refused(address, monkeypatch):
    monkeypatch.setattr(module, "_own_version", lambda: "0.0")
    with (
        pytest.raises(ValueError, match=r"has zoomjax .*, and here it is 0\.0"),
        cluster_executor(address, quiet=True),
    ):
        pass
