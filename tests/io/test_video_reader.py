"""Videos whose file says more than their pictures: frames that are not shown, pixels, fields, damage."""

import contextlib
import io
import re
import struct
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import cv2
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct import _segments
from zoomjax.detect import video_frames
from zoomjax.io import FocalTrack, decode_video
from zoomjax.io.video_crop import _elements, shown_size
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
        stream.pix_fmt = {"png": "rgb24", "mjpeg": "yuvj420p"}.get(encoder, "yuv420p")
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


def joined(path, aspects=(1, 1)):
    """Two clips one after the other, the second of which begins again at 0 s."""
    content = b""
    for number, aspect in enumerate(aspects):
        part = path.with_name(f"{number}.ts")
        write(part, aspect=aspect)
        content += part.read_bytes()
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("aspect", [Fraction(1), Fraction(4, 3)])
def test_pixels_that_change_their_shape_are_said(aspect, tmp_path, recwarn):
    """As where a broadcast goes over to another programme; a file that is written has one shape."""
    with decode_video(joined(tmp_path / "in.ts", (Fraction(1), aspect))) as (_, frames):
        assert len(list(frames)) == 2 * FRAMES
    told = [str(warning.message) for warning in recwarn if "change their shape" in str(warning.message)]
    assert len(told) == (aspect != 1)
    assert all("from 1:1 to 4:3: split the video there" in one for one in told)


def between_keys(path, before=6):
    """A clip of a broadcast, cut anywhere: its first frames have no key frame, and are no pictures."""
    write(path.with_name("whole.ts"), number=2 * FRAMES, g="10", keyint_min="10", sc_threshold="0")
    with av.open(str(path.with_name("whole.ts"))) as given, av.open(str(path), "w") as out:
        stream = out.add_stream_from_template(given.streams.video[0])
        packets = [packet for packet in given.demux(video=0) if packet.size]
        kept = packets[10 - before :]
        first = min(packet.dts for packet in kept)
        for packet in kept:
            packet.pts, packet.dts, packet.stream = packet.pts - first, packet.dts - first, stream
            out.mux(packet)
    return path


@pytest.mark.parametrize("suffix", [".ts", ".mkv", ".mp4"])
@pytest.mark.parametrize("work", WORKS)
def test_frames_before_the_first_key_frame_are_said(work, suffix, tmp_path):
    """They were left out without a word; a track of all frames was then used six frames late."""
    path = between_keys(tmp_path / f"in{suffix}")
    with pytest.warns(UserWarning, match="first 6 frames of the video cannot be decoded") as warned:
        WORKS[work](path)
    assert len(warned) == 1
    with pytest.warns(UserWarning, match="first 6"), decode_video(path) as (announced, frames):
        assert [number for number, _, _ in frames] == list(range(announced)) == list(range(2 * FRAMES - 10))


def test_frames_are_numbered_alike_by_segments(tmp_path, monkeypatch):
    """Of a clip without its first key frame; frames before were counted by an executor alone."""
    path, numbers = between_keys(tmp_path / "in.mkv"), {}
    monkeypatch.setattr(_segments, "_LEAST", 8)
    at = FocalTrack.at
    for executor in (None, ThreadPoolExecutor(1)):
        asked = numbers.setdefault(executor, [])

        def asking(track, number, time, asked=asked):
            asked.append((number, round(time, 3)))
            return at(track, number, time)

        monkeypatch.setattr(FocalTrack, "at", asking)
        track = FocalTrack(np.arange(60.0), np.full(60, 20.0), by_time=False)
        with pytest.warns(UserWarning, match="first 6 frames"):
            done = zj.undistort_video(
                path, tmp_path / "out.mkv", lens=lens(), focal=track, executor=executor
            )
        assert (done.frames, done.lost) == (2 * FRAMES - 10, 6)
    one, several = numbers.values()
    assert one == sorted(set(several))


def put_together(path, *streams):
    """A file of several streams of pictures, of which each is a clip and its disposition."""
    with contextlib.ExitStack() as stack:
        out = stack.enter_context(av.open(str(path), "w"))
        taken = []
        for source, disposition in streams:
            given = stack.enter_context(av.open(str(source)))
            stream = out.add_stream_from_template(given.streams.video[0])
            stream.disposition = disposition
            taken.append((stream, [packet for packet in given.demux(video=0) if packet.size]))
        for stream, packets in taken:
            for packet in packets:
                packet.stream = stream
                out.mux(packet)
    return path


@pytest.mark.parametrize("work", WORKS)
def test_further_streams_of_pictures_are_said_and_covers_are_not_taken(work, tmp_path):
    disposition = av.stream.Disposition
    one, other = write(tmp_path / "one.mp4", number=4), write(tmp_path / "other.mp4", number=4)
    both = put_together(tmp_path / "both.mp4", (one, disposition.default), (other, disposition.default))
    with pytest.warns(UserWarning, match="2 streams of pictures: the one of 320 x 192 px, number"):
        WORKS[work](both)
    cover = write(tmp_path / "cover.mp4", "mjpeg", number=1)
    told = disposition.attached_pic
    WORKS[work](put_together(tmp_path / "cover-first.mp4", (cover, told), (one, disposition.default)))
    alone = put_together(tmp_path / "alone.mp4", (cover, told))
    with pytest.raises(ValueError, match="it has no video stream"):
        WORKS[work](alone)


def test_the_shape_of_pixels_that_the_container_alone_tells_stays(tmp_path):
    """As ``ffmpeg -c copy -aspect`` writes it: the result was shown in another shape."""
    path = write(tmp_path / "in.mp4", number=4)
    path.write_bytes(with_box(path.read_bytes(), box(b"pasp", struct.pack(">2I", 4, 3))))
    with pytest.warns(UserWarning, match="not square"):
        zj.undistort_video(path, tmp_path / "out.mp4", lens=lens(), focal=20.0)
    with av.open(str(tmp_path / "out.mp4")) as made:
        assert made.streams.video[0].sample_aspect_ratio == Fraction(4, 3)


def with_loss(path):
    """A broadcast of which the packets of one group of frames did not arrive."""
    write(path, number=2 * FRAMES, g="10", bf="0")
    data = path.read_bytes()
    packets = [data[start : start + 188] for start in range(0, len(data), 188)]
    own = [i for i, packet in enumerate(packets) if (packet[1] & 0x1F, packet[2]) == (1, 0)]
    begins = [i for i in own if packets[i][1] & 0x40]
    gone = {i for i in own if begins[10] <= i < begins[20]}
    gone -= {max(gone)} if len(gone) % 16 == 0 else set()  # packets are counted up to 15
    path.write_bytes(b"".join(packet for i, packet in enumerate(packets) if i not in gone))
    return path


@pytest.mark.parametrize("work", WORKS)
def test_packets_that_were_lost_are_said(work, tmp_path):
    """Frames after them took the focal lengths of earlier ones, without a word."""
    path = with_loss(tmp_path / "in.ts")
    with pytest.warns(UserWarning, match=r"lost after 0\.267 s, and perhaps later.* focal lengths by time"):
        WORKS[work](path)


def test_packets_that_were_lost_are_said_by_segments(tmp_path):
    path = with_loss(tmp_path / "in.ts")
    with ThreadPoolExecutor(1) as executor, pytest.warns(UserWarning, match="Packets of the video") as told:
        zj.undistort_video(path, tmp_path / "out.mp4", lens=lens(), focal=20.0, executor=executor)
    assert len([each for each in told if "were lost" in str(each.message)]) == 1


@pytest.mark.parametrize("suffix", [".ts", ".mpg"])
def test_times_that_jump_back_are_said(suffix, tmp_path, recwarn):
    """Of joined recordings a track by time gave the second one the focal lengths of the first."""
    part = write(tmp_path / f"part{suffix}", "mpeg2video", number=6).read_bytes()
    path = tmp_path / f"in{suffix}"
    path.write_bytes(part + part)
    with decode_video(path) as (_, frames):
        assert len(list(frames)) == 12
    told = [str(each.message) for each in recwarn if "jump back" in str(each.message)]
    assert len(told) == 1
    assert re.search(r"from 0\.1\d\d s to 0\.000 s, at frame 6, .* ffmpeg -fflags \+genpts", told[0])


def test_times_that_jump_back_are_said_by_segments(tmp_path):
    part = write(tmp_path / "part.ts", "mpeg2video", number=6).read_bytes()
    (tmp_path / "in.ts").write_bytes(part + part)
    with (
        ThreadPoolExecutor(1) as executor,
        pytest.warns(UserWarning, match="unless recordings were joined"),
        pytest.warns(UserWarning, match="jump back"),
    ):
        zj.undistort_video(
            tmp_path / "in.ts", tmp_path / "out.mkv", lens=lens(), focal=20.0, executor=executor
        )


def test_fields_that_begin_later_are_said(tmp_path):
    """Of a broadcast some parts may be of fields, and others of frames."""
    parts = [
        write(tmp_path / "frames.ts", number=4),
        write(tmp_path / "fields.ts", number=4, flags="+ildct", **{"x264-params": "tff=1"}),
    ]
    path = tmp_path / "in.ts"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    with (
        pytest.warns(UserWarning, match="unless recordings were joined"),
        pytest.warns(UserWarning, match="jump back"),
        pytest.warns(UserWarning, match=r"interlaced.* Deinterlace it first") as warned,
    ):
        zj.undistort_video(path, tmp_path / "out.mp4", lens=lens(), focal=20.0)
    assert sum("interlaced" in str(each.message) for each in warned) == 1


def test_frames_of_tracks_that_are_not_those_of_the_file_are_said(tmp_path):
    path = damage(write(tmp_path / "in.mov", "png"), (5, 6))
    with pytest.warns(UserWarning, match=r"2 of 20 frames of .*in\.mov cannot be decoded: the tracks"):
        tracks = track_video(path)
    assert tracks.frames == FRAMES - 2
    with decode_video(path) as (_, frames):
        assert [number for number, _, _ in frames] == [*range(5), *range(7, FRAMES)]


def overwritten(path, places):
    """The same file with frames of which nothing but the beginning is left."""
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as given:
        taken = [(packet.pos, packet.size) for packet in given.demux(video=0) if packet.size]
    for place in places:
        start, size = taken[place]
        data[start + 8 : start + size] = b"\xff" * (size - 8)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_a_group_of_frames_that_decoders_leave_out_in_silence_is_said(suffix, tmp_path):
    """Of MPEG-2 and HEVC: frames after it had the numbers of earlier ones, or the file was to end early."""
    path = overwritten(write(tmp_path / f"in{suffix}", "mpeg2video", g="5", bf="0"), range(5, 10))
    with decode_video(path) as (_, frames):
        numbers = [number for number, _, _ in frames]
    assert numbers == [*range(5), *range(10, FRAMES)]
    told = rf"5 of 20 frames of .*in{suffix} cannot be decoded"
    with pytest.warns(UserWarning, match=rf"{told} \(their data are damaged\): 15 were written\.$"):
        done = zj.undistort_video(path, tmp_path / "out.mkv", lens=lens(), focal=20.0)
    assert (done.frames, done.lost) == (15, 5)
    with pytest.warns(UserWarning, match=rf"{told}, as their data are damaged\. The others are used"):
        assert len(list(video_frames(path, 20.0, FRAMES))) == 15
    with pytest.warns(UserWarning, match=rf"{told}: the tracks number"):
        track_video(path)


def test_frames_of_avi_that_decoders_leave_out_in_silence_are_counted(tmp_path):
    """It tells no times of frames, so that those after them are taken for earlier ones."""
    path = overwritten(write(tmp_path / "in.avi", "mpeg2video", g="5", bf="0"), range(5, 10))
    told = r"5 of 20 frames .* damaged\): 15 were written, and those after them count as earlier ones"
    with pytest.warns(UserWarning, match=told):
        done = zj.undistort_video(path, tmp_path / "out.mkv", lens=lens(), focal=20.0)
    assert (done.frames, done.lost) == (15, 5)


def box(name, content):
    """A box of MP4 or MOV."""
    return struct.pack(">I4s", 8 + len(content), name) + content


def with_box(content, added, path=(b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")):
    """The boxes of an MP4 file with one more in the description of its pictures."""
    made, place = b"", 0
    while place < len(content):
        length, name = struct.unpack_from(">I4s", content, place)
        inner = content[place + 8 : place + length]
        if name == path[0] == b"stsd":
            inner = inner[:8] + box(inner[12:16], inner[16:] + added)
        elif name == path[0]:
            inner = with_box(inner, added, path[1:])
        made, place = made + box(name, inner), place + length
    return made


def with_clap(content, shown=(400, 300)):
    """The boxes of an MP4 file with the part that is shown in the description of its pictures."""
    return with_box(content, box(b"clap", struct.pack(">8i", shown[0], 1, shown[1], 1, 0, 1, 0, 1)))


def with_crop(content, left=16, top=8):
    """A Matroska file with pixels that are not shown."""
    file, inside = io.BytesIO(content), []
    end = len(content)
    for name in (0x18538067, 0x1654AE6B, 0xAE, 0xE0):  # segment, tracks, track, video
        end = next(stop for found, stop in _elements(file, end) if found == name)
        inside.append((file.tell(), end))
    crop = b"\x54\xcc\x81" + bytes([left]) + b"\x54\xbb\x81" + bytes([top])
    grown = content[:end] + crop + content[end:]
    for start, stop in inside[1:]:  # their lengths; the segment's has room, for what follows it is skipped
        wide = next(n for n in range(1, 9) if _told(content, start, n) == 1 << 7 * n | stop - start)
        told = (1 << 7 * wide | stop - start + len(crop)).to_bytes(wide, "big")
        grown = grown[: start - wide] + told + grown[start:]
    return grown


def _told(content, start, wide):
    """The length before an element's content, with the mark of its own length."""
    return int.from_bytes(content[start - wide : start], "big")


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv"])
def test_a_part_that_alone_is_to_be_shown_is_said(suffix, tmp_path):
    path = write(tmp_path / f"in{suffix}", number=4)
    zj.undistort_video(path, tmp_path / "whole.mp4", lens=lens(), focal=20.0)
    left, top = 16, 8
    content = path.read_bytes()
    shown = (SIZE[0] - left, SIZE[1] - top)
    path.write_bytes(with_crop(content) if suffix == ".mkv" else with_clap(content, shown=shown))
    with pytest.warns(
        UserWarning, match=f"says to show {shown[0]} x {shown[1]} of its {SIZE[0]} x {SIZE[1]}"
    ):
        zj.undistort_video(path, tmp_path / "out.mp4", lens=lens(), focal=20.0)
    with pytest.warns(UserWarning, match="says to show"), decode_video(path) as (number, frames):
        assert len(list(frames)) == number == 4


def test_the_whole_picture_may_be_marked(tmp_path):
    path = write(tmp_path / "in.mp4", number=4)
    path.write_bytes(with_clap(path.read_bytes(), shown=SIZE))
    assert zj.undistort_video(path, tmp_path / "out.mp4", lens=lens(), focal=20.0).frames == 4


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_damaged_heads_say_nothing_of_it(suffix, tmp_path, rng):
    path = write(tmp_path / f"in{suffix}", number=4)
    content = with_crop(path.read_bytes()) if suffix == ".mkv" else with_clap(path.read_bytes())
    for _ in range(300):
        data = np.frombuffer(content, np.uint8).copy()
        data[rng.integers(0, data.size, 40)] = rng.integers(0, 256, 40)
        path.write_bytes(data[: rng.integers(0, data.size)].tobytes())
        found = shown_size(path, SIZE)
        assert found is None or (0 < found[0] <= SIZE[0] and 0 < found[1] <= SIZE[1])


def uneven(path, gap=3.0):
    """A clip without one frame in some seconds, as of cameras that stop for a moment."""
    times = [number / 25 + (gap if number > 4 else 0) for number in range(10)]
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=25)
        (stream.width, stream.height), stream.pix_fmt = SIZE, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, time in enumerate(times):
            grey = np.full(SIZE[::-1], 20 * number, np.uint8)
            frame = av.VideoFrame.from_ndarray(grey, "gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = round(1000 * time), Fraction(1, 1000)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return times


@pytest.mark.parametrize("suffix", [".mkv", ".mp4", ".avi"])
def test_times_of_frames_stay_where_they_are_uneven(suffix, tmp_path):
    """In AVI, which fills gaps with chunks without content, and has no order but that of packets."""
    times = uneven(tmp_path / "in.mkv")
    done = zj.undistort_video(tmp_path / "in.mkv", tmp_path / f"a{suffix}", lens=lens(), focal=20.0)
    again = zj.undistort_video(tmp_path / f"a{suffix}", tmp_path / "b.mkv", lens=lens(), focal=20.0)
    assert (done.frames, done.lost, again.frames, again.lost) == (10, 0, 10, 0)
    for name in (f"a{suffix}", "b.mkv"):
        with decode_video(tmp_path / name) as (number, frames):
            found = [(time, decode().mean()) for _, time, decode in frames]
        assert number in (0, 10)
        np.testing.assert_allclose([time for time, _ in found], times, atol=2e-3)
        assert (np.diff([grey for _, grey in found]) > 0).all()


def test_an_avi_file_that_is_cut_off_is_said(tmp_path):
    path = write(tmp_path / "in.avi", "mjpeg")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.warns(UserWarning, match=rf"of {FRAMES} frames of .* cannot be decoded"):
        zj.undistort_video(path, tmp_path / "out.mp4", lens=lens(), focal=20.0)
