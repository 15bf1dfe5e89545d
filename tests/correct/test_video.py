"""Zooming clips, corrected: straight edges, times, colours, sound, and everything that can be wrong."""

import os
import struct
import subprocess
import sys
import threading
import time
import warnings

import av
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct._planes import sampled_planes
from zoomjax.correct.video import undistort_video
from zoomjax.io.pyav import open_container
from zoomjax.io.video_reader import decode_video
from zoomjax.io.video_writer import display_matrix

from .._clips import FRAMES, SIZE, bend, focal, lens, luma, picture, write_clip, write_frames

TRACK = zj.io.FocalTrack(np.array([0.0, FRAMES - 1]), np.array([20.0, 80.0]), by_time=False)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_clip(tmp_path_factory.mktemp("clip") / "zoom.mp4", variable=True)


def test_every_frame_comes_out_straight(clip, tmp_path):
    before, _ = luma(clip)
    done = undistort_video(clip, tmp_path / "out.mp4", lens=lens(), focal=TRACK)
    after, _ = luma(tmp_path / "out.mp4")
    assert (done.frames, done.lost, done.scale) == (FRAMES, 0, 1.0)
    assert bend(before[0]) > 1.3
    assert bend(before[-1]) > 0.35
    assert max(bend(frame) for frame in after) <= 0.15
    for number in (0, 9, FRAMES - 1):  # planes as they are: what undistort_image makes of the luma
        expected = zj.undistort_image(before[number], lens()(float(focal(number))), border_value=0)
        assert np.median(abs(after[number].astype(int) - expected)) <= 2


def test_times_colours_and_sound_are_kept(clip, tmp_path):
    undistort_video(clip, tmp_path / "out.mp4", lens=lens(), focal=30.0)
    np.testing.assert_array_equal(luma(tmp_path / "out.mp4")[1], luma(clip)[1])
    with av.open(str(clip)) as a, av.open(str(tmp_path / "out.mp4")) as b:
        assert [s.type for s in a.streams] == [s.type for s in b.streams]
        before, after = a.streams.video[0], b.streams.video[0]
        for what in ("color_primaries", "color_trc", "colorspace", "color_range", "pix_fmt", "name"):
            assert getattr(before.codec_context, what) == getattr(after.codec_context, what)
        assert float(before.average_rate) == pytest.approx(float(after.average_rate), rel=0.02)
        sound = [[(p.pts, bytes(p)) for p in c.demux(audio=0) if p.size] for c in (a, b)]
        assert len(sound[0]) > 30
        assert sound[0] == sound[1]


def test_track_in_seconds_and_one_framing_for_all(clip, tmp_path):
    times = luma(clip)[1]
    track = zj.io.FocalTrack(times[[0, -1]], np.array([20.0, 80.0]))
    done = undistort_video(clip, tmp_path / "out.mkv", lens=lens(), focal=track, keep="valid")
    after, _ = luma(tmp_path / "out.mkv")
    assert done.scale == pytest.approx(
        float(zj.correct.frame_output(lens(), SIZE, keep="valid").scale), rel=1e-6
    )
    assert done.scale > 1.04
    corners = after[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners > 15).all()  # no black, at any focal length


@pytest.mark.parametrize("pixels", ["yuv422p", "yuv444p", "yuv420p10le", "gray"])
def test_pixel_formats(tmp_path, pixels):
    source = write_clip(tmp_path / "in.mkv", 3, encoder="ffv1", pixels=pixels, sound=False)
    undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=20.0)
    with av.open(str(tmp_path / "out.mkv")) as out:
        assert out.streams.video[0].codec_context.pix_fmt == pixels
        assert out.streams.video[0].codec_context.name == "ffv1"
        frame = next(out.decode(video=0))
        rgb = frame.to_ndarray(format="rgb24")
    expected = zj.undistort_image(luma(source)[0][0], lens()(20.0))
    inner = np.s_[20:-20, 30:-30]
    assert (
        np.abs(frame.reformat(format="gray").to_ndarray()[inner].astype(int) - expected[inner]).max() <= 3
    )
    assert np.ptp(rgb[inner].astype(int), axis=-1).max() <= 3  # grey stayed grey


def rotated(path, *, interlaced=False):
    """A short clip that players turn by 90 degrees and mirror; or one of fields."""
    options = {"crf": "6", **({"flags": "+ildct", "x264-params": "tff=1"} if interlaced else {})}
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=30, options=options)
        stream.width, stream.height = SIZE
        if not interlaced:
            stream.set_display_rotation(90, hflip=True)
        for number in range(3):
            grey = av.VideoFrame.from_ndarray(picture(number), "gray")
            out.mux(stream.encode(grey.reformat(format="yuv420p")))
        out.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_orientation_is_kept_and_pixels_are_not_turned(tmp_path, suffix):
    source = rotated(tmp_path / f"in{suffix}")
    undistort_video(source, tmp_path / f"out{suffix}", lens=lens(), focal=20.0)
    matrices = []
    for name in ("in", "out"):
        with av.open(str(tmp_path / f"{name}{suffix}")) as container:
            frame = next(container.decode(video=0))
            assert (frame.width, frame.height, frame.rotation) == (*SIZE, 90)
            matrices.append(display_matrix(frame))
    assert matrices[0] == matrices[1] != [65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30]


def test_fields_are_said(tmp_path):
    source = rotated(tmp_path / "in.mp4", interlaced=True)
    with pytest.warns(UserWarning, match="interlaced.* Deinterlace it first"):
        undistort_video(source, tmp_path / "out.mp4", lens=lens(), focal=20.0)


def test_replicated_border_has_no_black(clip, tmp_path):
    for border, low, high in (("constant", 0, 1), ("replicate", 40, 50)):
        undistort_video(clip, tmp_path / "out.mp4", lens=lens(), focal=80.0, border=border)
        corner = luma(tmp_path / "out.mp4")[0][0, :4, :4]
        assert low <= corner.min() <= corner.max() <= high


def test_sound_that_the_container_does_not_take(clip, tmp_path):
    with pytest.raises(ValueError, match=r"Cannot keep the sound \(aac\) in a \.webm file.*, \.mkv, or"):
        undistort_video(clip, tmp_path / "out.webm", lens=lens(), focal=20.0)
    assert only(tmp_path)


def test_of_joined_recordings_it_is_told_that_times_begin_again(tmp_path):
    """It was told as sound that no container takes, with the advice to choose the one that was chosen."""
    part = write_clip(tmp_path / "part.ts", 6).read_bytes()
    (tmp_path / "in.ts").write_bytes(part + part)
    joined = pytest.warns(UserWarning, match="unless recordings were joined there")
    with joined, pytest.raises(ValueError, match="times begin again, give them new ones first"):
        undistort_video(tmp_path / "in.ts", tmp_path / "out.mkv", lens=lens(), focal=20.0)
    assert only(tmp_path, "part.ts", "in.ts")


def test_a_framing_of_one_s_own_and_odd_sizes(tmp_path):
    source = write_clip(tmp_path / "in.mkv", 3, encoder="ffv1", sound=False)
    framing = zj.correct.frame_output(lens(), SIZE, keep="all", size=(201, 99))
    done = undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=20.0, keep=framing)
    after, _ = luma(tmp_path / "out.mkv")
    assert after.shape == (3, 99, 201)
    assert done.scale == float(framing.scale)
    expected = zj.undistort_image(luma(source)[0][0], lens()(20.0), keep=framing)
    assert np.abs(after[0].astype(int) - expected).max() <= 2  # of 219 steps, shown in 255
    with pytest.raises(ValueError, match="Choose another encoder, container, or even size"):
        undistort_video(
            source, tmp_path / "no.mp4", lens=lens(), focal=20.0, keep=framing, encoder="libx264"
        )
    assert only(tmp_path, "in.mkv", "out.mkv")


def test_progress_tells_frames_done_and_announced(clip, tmp_path):
    calls = []
    undistort_video(
        clip, tmp_path / "out.mp4", lens=lens(), focal=30.0, progress=lambda *call: calls.append(call)
    )
    assert calls == [(i, FRAMES) for i in range(1, FRAMES + 1)]


def only(folder, *names):
    """The folder holds these files and no other, hidden ones included."""
    return sorted(os.listdir(folder)) == sorted(names)


def test_short_track_leaves_nothing(clip, tmp_path):
    short = zj.io.FocalTrack(np.array([0.0, 9.0]), np.array([20.0, 80.0]), by_time=False)
    with pytest.raises(
        ValueError, match=r"ends at 9 frames, and the video has 24 frames\. Give a track as long"
    ):
        undistort_video(clip, tmp_path / "out.mp4", lens=lens(), focal=short)
    assert only(tmp_path)
    held = zj.io.FocalTrack(short.position, short.focal, by_time=False, hold=True)
    assert undistort_video(clip, tmp_path / "out.mp4", lens=lens(), focal=held).frames == FRAMES


@pytest.mark.parametrize("correct", [undistort_video, zj.correct.redistort_video])
def test_a_track_that_goes_on_after_the_video_is_said(clip, tmp_path, correct):
    longer = zj.io.FocalTrack(np.array([0.0, 48.0]), np.array([20.0, 80.0]), by_time=False)
    with pytest.warns(UserWarning, match=r"goes on to 48 frames, and the video ends at 23: is it"):
        assert correct(clip, tmp_path / "out.mp4", lens=lens(), focal=longer).frames == FRAMES


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("focal", ["30", "track.csv", [30.0] * 24, np.full(24, 30.0), None, True])
def test_what_is_neither_a_focal_length_nor_a_track_is_refused(clip, tmp_path, focal):
    with pytest.raises(TypeError, match=r"focal must be one focal length or a FocalTrack, .*read_focal"):
        undistort_video(clip, tmp_path / "out.mp4", lens=lens(), focal=focal)
    assert only(tmp_path)


def test_interruption_leaves_no_file_and_no_thread(clip, tmp_path):
    threads = threading.active_count()

    def interrupt(done, total):
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        undistort_video(clip, tmp_path / "out.mp4", lens=lens(), focal=30.0, progress=interrupt)
    assert only(tmp_path)
    deadline = time.monotonic() + 5
    while threading.active_count() > threads and time.monotonic() < deadline:
        time.sleep(0.02)
    assert threading.active_count() == threads


@pytest.mark.parametrize("content", [b"", b"this is no video" * 100, None])
def test_no_video(tmp_path, content):
    source = tmp_path / "bad.mp4"
    if content is not None:
        source.write_bytes(content)
    error, message = (
        (FileNotFoundError, "There is no video")
        if content is None
        else (ValueError, "Cannot read a video from .*bad.mp4")
    )
    with pytest.raises(error, match=message):
        undistort_video(source, tmp_path / "out.mp4", lens=lens(), focal=30.0)
    assert only(tmp_path, *(["bad.mp4"] if content is not None else []))


def test_only_sound(tmp_path):
    with av.open(str(tmp_path / "sound.mp4"), "w") as out:
        stream = out.add_stream("aac", rate=48000)
        tone = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", layout="mono")
        tone.sample_rate = 48000
        out.mux(stream.encode(tone))
        out.mux(stream.encode(None))
    with pytest.raises(ValueError, match="has no video stream"):
        undistort_video(tmp_path / "sound.mp4", tmp_path / "out.mp4", lens=lens(), focal=30.0)


def test_tags_that_are_not_utf_8_go_over_as_they_are(tmp_path):
    """As older recorders write them."""
    given = tmp_path / "in.avi"
    title = "Straße Ä".encode("latin-1").decode("utf-8", "surrogateescape")
    with open_container(given, "w") as out:
        out.metadata["title"] = title
        stream = out.add_stream("mpeg4", rate=30)
        stream.width, stream.height = SIZE
        for packet in [
            *stream.encode(av.VideoFrame.from_ndarray(picture(0), "gray")),
            *stream.encode(None),
        ]:
            out.mux(packet)
    undistort_video(given, tmp_path / "out.avi", lens=lens(), focal=30.0)
    with open_container(tmp_path / "out.avi") as found:
        assert found.metadata["title"] == title


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.mp4")
    (tmp_path / "folder.mp4").mkdir()
    for name in ("pipe.mp4", "folder.mp4"):
        with pytest.raises(
            ValueError, match=rf"Cannot read a video from .*{name}: it is not a regular file"
        ):
            undistort_video(tmp_path / name, tmp_path / "out.mp4", lens=lens(), focal=30.0)


def test_cut_off_mp4_is_named(clip, tmp_path):
    whole = clip.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])  # the index at its end is gone
    with pytest.raises(ValueError, match=r"cut\.mp4.*damaged, cut off"):
        undistort_video(tmp_path / "cut.mp4", tmp_path / "out.mp4", lens=lens(), focal=30.0)
    assert only(tmp_path, "cut.mp4")


@pytest.mark.parametrize("sound", [False, True])
def test_a_cut_off_matroska_file_is_said(tmp_path, sound):
    """It tells its length in seconds, and no number of frames."""
    source = write_clip(tmp_path / "in.mkv", encoder="ffv1", sound=sound)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=TRACK).lost == 0
    content = source.read_bytes()
    source.write_bytes(content[: len(content) // 2])
    with pytest.warns(UserWarning, match=r"\d+ of 2\d frames of .*in\.mkv cannot be decoded .*ends early"):
        done = undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=TRACK)
    assert 20 <= done.frames + done.lost <= 28
    assert done.lost >= 8


def test_a_matroska_file_whose_pictures_end_before_its_sound_is_said(tmp_path):
    """Its sound tells nothing of where pictures should end."""
    source, cut = write_clip(tmp_path / "in.mkv", encoder="ffv1"), tmp_path / "cut.mkv"
    with av.open(str(source)) as given, av.open(str(cut), "w") as out:
        into = {stream.index: out.add_stream_from_template(stream) for stream in given.streams}
        number = 0
        for packet in given.demux():
            number += packet.stream.type == "video"
            if packet.dts is not None and (packet.stream.type == "audio" or number <= 16):
                packet.stream = into[packet.stream.index]
                out.mux(packet)
    content = cut.read_bytes()
    with av.open(str(cut)) as container:
        told = container.streams.video[0].metadata["DURATION"].encode()
    with av.open(str(source)) as container:
        whole = container.streams.video[0].metadata["DURATION"].encode()
    assert told != whole
    cut.write_bytes(content.replace(told, whole))
    with pytest.warns(UserWarning, match=r"\d of 2\d frames of .*cut\.mkv cannot be decoded .*ends early"):
        done = undistort_video(cut, tmp_path / "out.mkv", lens=lens(), focal=TRACK)
    assert done.frames == 16
    assert 7 <= done.lost <= 9


@pytest.mark.parametrize(
    ("suffix", "share", "options"),
    [
        (".mp4", 0.7, {"movflags": "frag_keyframe+empty_moov"}),  # which tells no number of frames
        (".mov", 0.99, {"movflags": "faststart"}),  # where sound alone is missing
        (".mkv", 0.99, {}),
        (".flv", 0.7, {}),
        (".mxf", 0.7, {}),
    ],
)
def test_a_file_that_is_cut_off_is_said_whatever_its_format(suffix, share, options, tmp_path):
    """Unless its format has no end, as transport streams. Whole files are not said to be cut off."""
    source, encoder = tmp_path / f"in{suffix}", "mpeg2video" if suffix == ".mxf" else "libx264"
    with av.open(str(source), "w", options=options) as out:
        video = out.add_stream(encoder, rate=25, options={"g": "6"})
        video.width, video.height, video.pix_fmt = *SIZE, "yuv420p"
        sound = out.add_stream("pcm_s16le" if suffix == ".mxf" else "aac", rate=48000)
        sound.layout = "mono"
        noise = np.random.default_rng(0).integers(-3000, 3000, (FRAMES, 1, 1920)).astype(np.int16)
        for number, samples in enumerate(noise):
            frame = av.VideoFrame.from_ndarray(picture(number), "gray").reformat(format="yuv420p")
            frame.pts = number
            out.mux(video.encode(frame))
            heard = av.AudioFrame.from_ndarray(samples, format="s16", layout="mono")
            heard.sample_rate, heard.pts = 48000, 1920 * number
            out.mux(sound.encode(heard))
        out.mux([*video.encode(None), *sound.encode(None)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert undistort_video(source, tmp_path / "whole.mkv", lens=lens(), focal=30.0).frames == FRAMES
    content = source.read_bytes()
    source.write_bytes(content[: int(share * len(content))])
    with pytest.warns(UserWarning, match=r"is cut off at its end: \d+ frames|\d+ of 2\d frames of") as told:
        done = undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=30.0)
    assert len(told) == 1
    assert abs(done.frames + done.lost - FRAMES) <= 1 or suffix == ".mp4"


def test_a_last_frame_that_does_not_decode_is_said(tmp_path):
    """Matroska tells no number of frames, and the decoder of FFV1 nothing of those that it leaves out."""
    source = write_clip(tmp_path / "in.mkv", encoder="ffv1", sound=False)
    with av.open(str(source)) as container:
        last = [bytes(p) for p in container.demux(video=0) if p.size][-1]
    source.write_bytes(source.read_bytes().replace(last, last[:-8] + b"\xff" * 8))
    with pytest.warns(UserWarning, match=rf"1 of {FRAMES} frames of .*in\.mkv cannot be decoded"):
        done = undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=TRACK)
    assert (done.frames, done.lost) == (FRAMES - 1, 1)


def test_an_avi_file_with_a_damaged_index_is_said_to_end_early(tmp_path):
    """Its header tells how many frames there should be, and the index tells of fewer than there are."""
    source = write_frames(
        tmp_path / "in.avi", [np.dstack([picture(n)] * 3) for n in range(8)], encoder="mpeg4"
    )
    content = source.read_bytes()
    index = content.rindex(b"idx1")
    last = content.rindex(b"00dc", 0, index)
    one = content[index + 8 : index + 24]  # the entry of the first frame
    rest = content[8:last] + b"idx1" + struct.pack("<I", len(one)) + one
    source.write_bytes(content[:4] + struct.pack("<I", len(rest)) + rest)
    with pytest.warns(UserWarning, match=r"1 of 8 frames of .*in\.avi cannot be decoded .*ends early"):
        done = undistort_video(source, tmp_path / "out.avi", lens=lens(), focal=30.0)
    assert (done.frames, done.lost) == (7, 1)


def test_last_frames_that_do_not_decode_are_counted(tmp_path):
    """The data of the last third of an MP4 with its index in front are overwritten."""
    source = write_clip(tmp_path / "in.mp4", encoder="mpeg4", sound=False)
    with av.open(str(source)) as container:
        packets = [(p.pos, p.size) for p in container.demux(video=0) if p.size]
    content = bytearray(source.read_bytes())
    for position, size in packets[16:]:
        content[position : position + size] = bytes(size)
    source.write_bytes(bytes(content))
    with pytest.warns(UserWarning, match=r"\d+ of 24 frames of .*in\.mp4 cannot be decoded"):
        done = undistort_video(source, tmp_path / "out.mp4", lens=lens(), focal=TRACK)
    assert done.frames >= 15
    assert done.lost >= 1
    after, _ = luma(tmp_path / "out.mp4")
    assert len(after) == done.frames
    assert max(bend(frame) for frame in after[:15]) <= 0.4  # MPEG-4 part 2 blurs


def test_frames_after_lost_ones_keep_their_numbers(tmp_path):
    """The data of frames 5 to 7 are overwritten: frame 8 is still frame 8, at its own focal length."""
    source = write_clip(tmp_path / "in.mkv", encoder="mjpeg", pixels="yuvj420p", sound=False)
    with av.open(str(source)) as container:
        packets = [bytes(p) for p in container.demux(video=0) if p.size]
    content = source.read_bytes()
    for packet in packets[5:8]:
        content = content.replace(packet, bytes(len(packet)))
    source.write_bytes(content)
    step = zj.io.FocalTrack(np.array([0, 7.0, 8, 23]), np.array([80.0, 80, 20, 20]), by_time=False)
    with pytest.warns(UserWarning, match=r"3 of 2\d frames of .*in\.mkv cannot be decoded"):
        done = undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=step, encoder="ffv1")
    assert done.frames == FRAMES - 3
    after, _ = luma(tmp_path / "out.mkv")
    with decode_video(source) as (_, frames), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert [number for number, *_ in frames] == [*range(5), *range(8, FRAMES)]
    for index, number, f in ((4, 4, 80.0), (5, 8, 20.0), (7, 10, 20.0), (20, 23, 20.0)):
        right, wrong = (
            np.mean(abs(after[index].astype(int) - zj.undistort_image(picture(number), lens()(at))))
            for at in (f, 100 - f)
        )
        assert right < wrong / 3


def test_a_track_in_seconds_needs_frames_with_times(clip, tmp_path):
    """A bare H.264 stream has none; FFmpeg guesses 25 frames a second for this one of 30."""
    with av.open(str(clip)) as given, av.open(str(tmp_path / "raw.h264"), "w", format="h264") as out:
        stream = out.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    seconds = zj.io.FocalTrack(np.array([0.0, 2.0]), np.array([20.0, 80.0]), hold=True)
    with pytest.raises(ValueError, match="frames of the video have no times"):
        undistort_video(tmp_path / "raw.h264", tmp_path / "out.mkv", lens=lens(), focal=seconds)
    assert only(tmp_path, "raw.h264")
    with decode_video(tmp_path / "raw.h264") as (_, frames):
        assert all(np.isnan(time) for _, time, _ in frames)


@pytest.mark.parametrize(
    ("name", "step"), [("yuv420p", (2, 2)), ("yuv411p", (4, 1)), ("yuv410p", (4, 4)), ("yuv444p", (1, 1))]
)
@pytest.mark.parametrize("size", [(64, 48), (1, 1), (5, 7), (6, 6), (97, 65)])
def test_chroma_of_odd_sizes_is_sampled_as_of_even_ones(name, step, size):
    luminance, *colours = sampled_planes(name, size)
    assert (luminance.size, luminance.step, luminance.offset) == (size, (1, 1), (0, 0))
    for plane in colours:
        assert plane.step == step
        assert plane.size == tuple(-(-side // each) for side, each in zip(size, step, strict=True))


def test_no_frame_decodes(tmp_path):
    source = write_clip(tmp_path / "in.mp4", 4, encoder="mpeg4", sound=False)
    with av.open(str(source)) as container:
        packets = [(p.pos, p.size) for p in container.demux(video=0) if p.size]
    content = bytearray(source.read_bytes())
    for position, size in packets:
        content[position : position + size] = bytes(size)
    source.write_bytes(bytes(content))
    with pytest.raises(ValueError, match=r"in\.mp4: none of its frames can be decoded"):
        undistort_video(source, tmp_path / "out.mp4", lens=lens(), focal=30.0)
    assert only(tmp_path, "in.mp4")


def test_other_size_is_scaled_and_other_aspect_explained(clip, tmp_path):
    with pytest.warns(UserWarning, match="its distortion is scaled"):
        undistort_video(clip, tmp_path / "out.mp4", lens=lens((640, 384)), focal=TRACK)
    assert max(bend(frame) for frame in luma(tmp_path / "out.mp4")[0]) <= 0.15
    with pytest.raises(ValueError, match="another aspect ratio"):
        undistort_video(clip, tmp_path / "no.mp4", lens=lens((640, 480)), focal=TRACK)
    assert only(tmp_path, "out.mp4")


def test_outside_of_the_fitted_range_is_said(clip, tmp_path):
    with pytest.warns(UserWarning, match="fitted, 20 to 80 mm: beyond it the distortion is extrapolated"):
        undistort_video(clip, tmp_path / "out.mp4", lens=lens(), focal=15.0)


def test_fold_is_said(clip, tmp_path):
    zoom = zj.PolynomialZoom(0, np.array([[-0.6]]), np.array(20.0))
    folding = zj.ZoomLens(zoom, lens().centre, lens().focal_range, SIZE)
    with pytest.warns(UserWarning, match="not invertible on this image"):
        undistort_video(clip, tmp_path / "out.mp4", lens=folding, focal=30.0)


@pytest.mark.parametrize(
    ("target", "arguments", "error", "message"),
    [
        ("out.gifv", {}, ValueError, r"must end in one of \.mp4"),
        ("out.mp4", {"encoder": "none such"}, ValueError, "Cannot encode with 'none such'"),
        ("missing/out.mp4", {}, OSError, "cannot write in the folder"),
    ],
)
def test_bad_targets(clip, tmp_path, target, arguments, error, message):
    with pytest.raises(error, match=message):
        undistort_video(clip, tmp_path / target, lens=lens(), focal=30.0, **arguments)
    assert only(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="Root may write anywhere.")
def test_no_permission(clip, tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OSError, match="cannot write in the folder"):
        undistort_video(clip, tmp_path / "out.mp4", lens=lens(), focal=30.0)
    tmp_path.chmod(0o700)


def test_full_disk_leaves_nothing(clip, tmp_path):
    """A limit on the size of files stands in for it: writing fails midway in the same manner."""
    (tmp_path / "out").mkdir()
    lens().save(tmp_path / "lens.json")
    limited = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (8000, 8000))\n"
    limited += "from zoomjax.app.cli import main; main()"
    done = subprocess.run(
        [
            *(sys.executable, "-c", limited, "undistort", tmp_path / "lens.json", clip),
            *("--focal", "30", "-o", tmp_path / "out" / "out.mp4"),
        ],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 2, done.stderr
    assert "Error: " in done.stderr
    assert "File too large" in done.stderr
    assert only(tmp_path / "out")


def test_pictures_are_bent_and_distinct():
    """The clip is a test of something: its edges are curved, one way and then the other."""
    assert bend(picture(0)) > 1.3
    assert (picture(0) != picture(FRAMES - 1)).any()
