"""Encoders in several threads: what they say must not keep FFmpeg talking to Python."""

import threading
import time

import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.io.video_writer import _warnings

av = pytest.importorskip("av")


def test_threads_leave_the_level_of_logging_as_it_was():
    """Else closing a decoder waits for its threads, which wait for Python to hear them, for ever."""
    before, entered = av.logging.get_level(), threading.Event()

    def other():
        with _warnings():
            entered.set()
            time.sleep(0.05)

    thread = threading.Thread(target=other)
    with _warnings():
        thread.start()
        entered.wait(0.2)
    thread.join()
    assert av.logging.get_level() == before


@pytest.mark.parametrize("options", [None, {}, {"crf": "20"}])
def test_so_does_a_video(tmp_path, options):
    before = av.logging.get_level()
    with av.open(str(tmp_path / "in.mkv"), "w") as out:
        stream = out.add_stream("ffv1", rate=25)
        stream.width, stream.height = 64, 48
        for value in range(3):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64), 80 * value, np.uint8), "gray")
            out.mux(stream.encode(frame.reformat(format="yuv420p")))
        out.mux(stream.encode(None))
    done = zj.correct.undistort_video(
        tmp_path / "in.mkv",
        tmp_path / "out.mkv",
        lens=scenes.nikkor_18_200((64, 48)),
        focal=50.0,
        encoder="libx264",
        options=options,
    )
    assert done.frames == 3
    assert av.logging.get_level() == before
