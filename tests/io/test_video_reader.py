"""Videos whose file says more than their pictures: frames that are not shown, pixels, fields, damage."""

from fractions import Fraction

import cv2
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.detect import video_frames
from zoomjax.io import FocalTrack, decode_video
from zoomjax.tracks import track_video

av = pytest.importorskip("av")

from .._clips import SIZE, lens, write_clip  # noqa: E402 (needs PyAV too)

FRAMES, HIDDEN = 20, 7


def trimmed(path):
    """The end of a clip, cut without encoding it anew: frames before lie in the file, and are not shown."""
    write_clip(path.with_name("whole.mp4"), FRAMES, sound=False)
    with (
        av.open(str(path.with_name("whole.mp4"))) as given,
        av.open(str(path), "w", options={"avoid_negative_ts": "disabled"}) as out,
    ):
        stream = out.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.size:
                shift = round(HIDDEN / 30 / packet.time_base)
                packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, stream
                out.mux(packet)
    return path


def write(path, encoder="libx264", number=FRAMES, aspect=1, **options):
    """A clip of a texture that moves by 3 px a frame."""
    noise = np.random.default_rng(0).integers(0, 256, (SIZE[1] // 8, SIZE[0] // 4), np.uint8)
    texture = cv2.resize(noise, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)
    with av.open(str(path), "w") as out:
        stream = out.add_stream(encoder, rate=30, options=options)
        stream.width, stream.height = SIZE
        stream.pix_fmt = "rgb24" if encoder == "png" else "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(aspect)
        for i in range(number):
            grey = np.ascontiguousarray(texture[:, 3 * i : 3 * i + SIZE[0]])
            frame = av.VideoFrame.from_ndarray(grey, "gray")
            out.mux(stream.encode(frame.reformat(format=stream.pix_fmt)))
        out.mux(stream.encode(None))
    return path


def damage(path, places):
    """Frames that cannot be decoded."""
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as given:
        starts = [packet.pos for packet in given.demux(video=0) if packet.size]
    for place in places:
        data[starts[place] : starts[place] + 60] = bytes(60)
    path.write_bytes(data)
    return path


def test_frames_that_are_not_shown_do_not_count(tmp_path, recwarn):
    """A clip of a telephone that was trimmed there. Its track is as long as what is shown."""
    source = trimmed(tmp_path / "in.mp4")
    with decode_video(source) as (announced, frames):
        numbers = [number for number, _, _ in frames]
    assert numbers == list(range(announced)) == list(range(FRAMES - HIDDEN))
    chosen = [each.name[-10:-4] for each in video_frames(source, 20.0, 3)]
    assert chosen == ["000000", "000006", "000012"]
    track = FocalTrack(np.arange(FRAMES - HIDDEN), np.full(FRAMES - HIDDEN, 20.0), by_time=False)
    done = zj.undistort_video(source, tmp_path / "out.mp4", lens=lens(), focal=track)
    assert (done.frames, done.lost) == (FRAMES - HIDDEN, 0)
    assert not recwarn.list


WORKS = {
    "undistort": lambda path: zj.undistort_video(path, path.parent / "out.mp4", lens=lens(), focal=20.0),
    "track": track_video,
    "frames": lambda path: list(video_frames(path, 20.0, 2)),
}


@pytest.mark.parametrize("work", WORKS)
def test_pixels_that_are_not_square_are_said(work, tmp_path):
    path = write(tmp_path / "in.mp4", number=4, aspect=Fraction(4, 3))
    with pytest.warns(
        UserWarning, match=r"pixels of 4:3, which are not square.* Scale it to square pixels"
    ):
        WORKS[work](path)


def test_fields_that_begin_later_are_said(tmp_path):
    """Of a broadcast some parts may be of fields, and others of frames."""
    parts = [
        write(tmp_path / "frames.ts", number=4),
        write(tmp_path / "fields.ts", number=4, flags="+ildct", **{"x264-params": "tff=1"}),
    ]
    path = tmp_path / "in.ts"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    with pytest.warns(UserWarning, match=r"interlaced.* Deinterlace it first") as warned:
        zj.undistort_video(path, tmp_path / "out.mp4", lens=lens(), focal=20.0)
    assert len(warned) == 1


def test_frames_of_tracks_that_are_not_those_of_the_file_are_said(tmp_path):
    path = damage(write(tmp_path / "in.mov", "png"), (5, 6))
    with pytest.warns(UserWarning, match=r"2 of 20 frames of .*in\.mov cannot be decoded: the tracks"):
        tracks = track_video(path)
    assert tracks.frames == FRAMES - 2
    with decode_video(path) as (_, frames):
        assert [number for number, _, _ in frames] == [*range(5), *range(7, FRAMES)]
