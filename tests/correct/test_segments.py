"""Video by segments on an executor: the same pictures, times and sound, wherever it is cut."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from fractions import Fraction

import av
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct import _segments
from zoomjax.correct.video import redistort_video, undistort_video
from zoomjax.io.video_report import Report

from .._clips import FRAMES, SIZE, TICK, lens, luma, picture, write_clip, write_frames

TRACK = zj.io.FocalTrack(np.array([0.0, FRAMES - 1]), np.array([20.0, 80.0]), by_time=False)


@pytest.fixture(scope="module")
def threads():
    with ThreadPoolExecutor(2) as pool:
        yield pool


@pytest.fixture(autouse=True)
def _short_segments(monkeypatch):
    monkeypatch.setattr(_segments, "_LEAST", 5)


def keyed(path, encoder="libx264", options=None, sound=False):
    """A clip with a key frame every six frames, by default of open groups of pictures with B frames."""
    options = options or {"g": "6", "bf": "2", "crf": "6", "x264-params": "open-gop=1:scenecut=0"}
    with av.open(str(path), "w") as out:
        video = out.add_stream(encoder, rate=30, options=options)
        video.width, video.height, video.pix_fmt = *SIZE, "yuv420p"
        video.codec_context.time_base = TICK
        audio = out.add_stream("aac", rate=48000) if sound else None
        for number in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(picture(number), "gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = 512 * number + (180 if number % 2 else 0), TICK
            out.mux(video.encode(frame))
        out.mux(video.encode(None))
        if audio is not None:
            tone = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", layout="mono")
            tone.sample_rate = 48000
            for block in range(FRAMES * 1600 // 1024):
                tone.pts, tone.time_base = 1024 * block, Fraction(1, 48000)
                out.mux(audio.encode(tone))
            out.mux(audio.encode(None))
    return path


def number_of_segments(path):
    return len(_segments.cut(path, [], Report(0)))


X265 = {"x265-params": "keyint=6:min-keyint=6:open-gop=1:bframes=2:log-level=error", "crf": "8"}


@pytest.mark.parametrize(
    ("suffix", "encoder", "options"),
    [
        (".mp4", "libx264", None),
        (".mkv", "libx264", None),
        (".ts", "libx264", None),
        (".mov", "libx265", X265),
        (".mkv", "ffv1", {"g": "1"}),
        (".webm", "libvpx-vp9", {"g": "6", "crf": "20", "b": "0"}),
    ],
)
def test_pictures_and_times_are_those_of_one_piece(tmp_path, threads, suffix, encoder, options):
    """Without loss, so that each frame is compared to the last digit."""
    source = keyed(tmp_path / f"in{suffix}", encoder, options)
    assert number_of_segments(source) >= 3
    seen = []
    for name, executor in (("here", None), ("there", threads)):
        done = undistort_video(
            source, tmp_path / f"{name}.mkv", lens=lens(), focal=TRACK, encoder="ffv1", executor=executor
        )
        assert (done.frames, done.lost) == (FRAMES, 0)
        seen.append(luma(tmp_path / f"{name}.mkv"))
    np.testing.assert_array_equal(seen[0][0], seen[1][0])
    np.testing.assert_array_equal(seen[0][1], seen[1][1])


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".ts"])
def test_encoders_with_b_frames_give_one_stream(tmp_path, threads, suffix):
    """Times of decoding increase over cuts, sound is copied, every frame decodes."""
    source = keyed(tmp_path / f"in{suffix}", sound=True)
    undistort_video(source, tmp_path / f"here{suffix}", lens=lens(), focal=TRACK)
    counts = []
    undistort_video(
        source,
        tmp_path / f"there{suffix}",
        lens=lens(),
        focal=TRACK,
        executor=threads,
        progress=lambda done, total: counts.append(done),
    )
    assert counts[-1] == FRAMES
    assert len(counts) >= 3
    here, there = (luma(tmp_path / f"{name}{suffix}") for name in ("here", "there"))
    np.testing.assert_array_equal(here[1], there[1])
    assert np.abs(here[0].astype(int) - there[0]).mean() < 1
    sound = []
    for name in ("here", "there"):
        with av.open(str(tmp_path / f"{name}{suffix}")) as file:
            packets = [packet for packet in file.demux() if packet.size]
            sound.append([bytes(p) for p in packets if p.stream.type == "audio"])
            steps = [p.dts for p in packets if p.stream.type == "video" and p.dts is not None]
            assert (np.diff(steps) > 0).all()
    assert len(sound[0]) > 30
    assert sound[0] == sound[1]


def test_what_cannot_be_cut_is_corrected_here(tmp_path, threads):
    source = write_frames(tmp_path / "in.avi", [np.full((192, 320, 3), 90, np.uint8)] * 8)
    assert number_of_segments(source) == 0
    done = undistort_video(source, tmp_path / "out.avi", lens=lens(), focal=20.0, executor=threads)
    assert done.frames == 8


def test_one_group_of_pictures_is_one_segment(tmp_path, threads):
    source = write_clip(tmp_path / "in.mp4", 8)
    assert number_of_segments(source) == 1
    done = redistort_video(source, tmp_path / "out.mp4", lens=lens(), focal=20.0, executor=threads)
    assert done.frames == 8


def test_a_damaged_key_frame_costs_what_it_costs_in_one_piece(tmp_path, threads):
    source = keyed(tmp_path / "in.ts")
    with av.open(str(source)) as file:
        places = [p.pos for p in file.demux(video=0) if p.is_keyframe]
    content = bytearray(source.read_bytes())
    content[places[2] + 200 : places[2] + 900] = bytes(700)
    source.write_bytes(content)
    frames = []
    for name, executor in (("here", None), ("there", threads)):
        lost = pytest.warns(UserWarning, match="Packets of the video were lost")
        with lost, pytest.warns(UserWarning, match="cannot be decoded"):
            done = undistort_video(
                source,
                tmp_path / f"{name}.mkv",
                lens=lens(),
                focal=TRACK,
                encoder="ffv1",
                executor=executor,
            )
        frames.append(done.frames)
    assert abs(frames[0] - frames[1]) <= 1


def test_a_track_that_is_too_short_is_refused_from_a_task_too(tmp_path, threads):
    source = keyed(tmp_path / "in.ts")  # which does not tell its length in advance
    track = zj.io.FocalTrack(np.array([0.0, 15.0]), np.array([20.0, 80.0]), by_time=False)
    with pytest.raises(ValueError, match="goes from 0 to 15 frames, and frame"):
        undistort_video(source, tmp_path / "out.ts", lens=lens(), focal=track, executor=threads)
    assert not (tmp_path / "out.ts").exists()


def test_a_segment_that_ends_its_workers_is_said_to_do_so(tmp_path):
    """As Dask says of a task whose workers died one after the other."""

    class KilledWorker(Exception):
        pass

    class Killing(ThreadPoolExecutor):
        def submit(self, function, /, *given):
            def killed(*given):
                raise KilledWorker("attempted to run task on 4 workers")

            return super().submit(killed)

    source = keyed(tmp_path / "in.mp4")
    with (
        Killing(1) as pool,
        pytest.raises(ValueError, match=r"in\.mp4: the task of a segment failed: KilledWorker: attempted"),
    ):
        undistort_video(source, tmp_path / "out.mp4", lens=lens(), focal=TRACK, executor=pool)
    assert not (tmp_path / "out.mp4").exists()


@pytest.mark.slow
def test_processes_without_float64_compute_in_that_of_the_lens(tmp_path):
    source = keyed(tmp_path / "in.mp4")
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        for name, executor in (("here", None), ("there", pool)):
            undistort_video(
                source,
                tmp_path / f"{name}.mkv",
                lens=lens(),
                focal=TRACK,
                encoder="ffv1",
                executor=executor,
            )
    np.testing.assert_array_equal(luma(tmp_path / "here.mkv")[0], luma(tmp_path / "there.mkv")[0])
