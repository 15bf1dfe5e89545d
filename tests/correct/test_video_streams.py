"""What goes along with the pictures, in files of FFmpeg's encoders: copied where it can be, else said."""

import re
import struct
import warnings
from fractions import Fraction

import av
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct.video import redistort_video, undistort_video
from zoomjax.io.video_hdr import side_data
from zoomjax.io.video_reader import decode_video

from .._clips import FRAMES, SIZE, lens, luma, picture, write_clip

MILLI = Fraction(1, 1000)
CHAPTERS = [
    {"id": 1, "start": 0, "end": 300, "time_base": MILLI, "metadata": {"title": "Wide"}},
    {"id": 2, "start": 300, "end": 800, "time_base": MILLI, "metadata": {"title": "Long"}},
]


def clip(
    path, *, encoder="libx264", pixels="yuv420p", size=SIZE, stamps=range(4), options=None, rich=False
):
    """Frames at these times of 1/25 s; if rich, with subtitles, chapters and an attachment."""
    with av.open(str(path), "w") as out:
        video = out.add_stream(encoder, rate=25, options=options or {})
        video.width, video.height = size
        video.pix_fmt = pixels
        video.codec_context.time_base = Fraction(1, 25)
        if rich:
            texts = out.add_mux_stream("subrip")
            texts.time_base, texts.metadata["language"] = MILLI, "eng"
            out.set_chapters(CHAPTERS)
            out.add_attachment("font.ttf", "font/ttf", b"letters" * 9)
        for number in stamps:
            grey = av.VideoFrame.from_ndarray(np.resize(picture(number), size[::-1]), "gray")
            frame = grey.reformat(format=pixels)
            frame.pts, frame.time_base = number, Fraction(1, 25)
            out.mux(video.encode(frame))
            if rich and number == 1:
                packet = av.Packet(b"Straight lines")
                packet.stream, packet.pts, packet.dts, packet.duration = texts, 40, 40, 80
                packet.time_base = MILLI
                out.mux(packet)
        out.mux(video.encode(None))
    return path


def packets(path, kind):
    with av.open(str(path)) as container:
        return [
            (float(p.pts * p.time_base), bytes(p))
            for p in container.demux()
            if p.stream.type == kind and p.dts is not None
        ]


def test_subtitles_chapters_and_attachments_go_over(tmp_path):
    source = clip(tmp_path / "in.mkv", rich=True)
    done = undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=20.0)
    assert packets(tmp_path / "out.mkv", "subtitle") == packets(source, "subtitle")
    assert packets(source, "subtitle") == [(0.04, b"Straight lines")]
    with av.open(str(tmp_path / "out.mkv")) as out:
        assert [chapter["metadata"]["title"] for chapter in out.chapters()] == ["Wide", "Long"]
        assert [float(c["end"] * c["time_base"]) for c in out.chapters()] == [0.3, 0.8]
        [font] = [stream for stream in out.streams if stream.type == "attachment"]
        assert bytes(font.data) == b"letters" * 9
        assert out.streams.subtitles[0].metadata["language"] == "eng"
    assert done.kept == ("subtitles (srt, eng)", "the attachment font.ttf", "chapters (2)")
    assert done.not_kept == ()


def test_what_a_container_does_not_hold_is_said(tmp_path):
    source = clip(tmp_path / "in.mkv", rich=True)
    done = undistort_video(source, tmp_path / "out.mp4", lens=lens(), focal=20.0)
    assert done.kept == ("chapters (2)",)
    assert done.not_kept == ("subtitles (srt, eng)", "the attachment font.ttf")
    done = undistort_video(source, tmp_path / "out.avi", lens=lens(), focal=20.0)
    assert done.not_kept == ("subtitles (srt, eng)", "the attachment font.ttf", "chapters (2)")


def spoken(path, tracks, codec="aac", late=0.0):
    """A video with silent sound of these languages, titles and marks."""
    with av.open(str(path), "w") as out:
        video = out.add_stream("libx264", rate=25)
        video.width, video.height = SIZE
        video.pix_fmt, video.disposition = "yuv420p", av.stream.Disposition.default
        sounds = []
        for tags, marks in tracks:
            sounds.append(sound := out.add_stream(codec, rate=48000))
            sound.metadata.update(tags)
            sound.disposition = marks
        for number in range(4):
            grey = av.VideoFrame.from_ndarray(np.resize(picture(number), SIZE[::-1]), "gray")
            frame = grey.reformat(format="yuv420p")
            frame.pts, frame.time_base = number, Fraction(1, 25)
            out.mux(video.encode(frame))
        out.mux(video.encode(None))
        for sound in sounds:
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            silence.sample_rate, silence.time_base = 48000, Fraction(1, 48000)
            silence.pts = round(late * 48000)
            out.mux(sound.encode(silence))
            out.mux(sound.encode(None))
    return path


def told(path):
    with av.open(str(path)) as made:
        return [
            (int(stream.disposition), stream.metadata.get("language"), stream.metadata.get("title"))
            for stream in made.streams
        ]


def test_languages_and_marks_of_sound_go_over_or_are_said(tmp_path):
    """The pictures of .mkv files lost their mark, and .mov ones languages, without a word."""
    marks = av.stream.Disposition
    tracks = [
        ({"language": "tlh"}, marks(0)),
        ({"language": "eng"}, marks.default),
        ({"language": "de", "title": "Talk"}, marks.comment),
    ]
    source = spoken(tmp_path / "in.mkv", tracks)
    assert told(source) == [
        (1, None, None),
        (0, "tlh", None),
        (1, "eng", None),
        (8, "de", "Talk"),
    ]
    lost = {
        ".mkv": (),
        ".mp4": ("the language and the title of the sound (aac, de)",),
        ".mov": (
            "the language of the sound (aac, tlh)",
            "the language and the title and the mark comment of the sound (aac, de)",
        ),
        ".ts": (
            "the mark default of the sound (aac, eng)",
            "the language and the title and the mark comment of the sound (aac, de)",
        ),
    }
    for suffix, names in lost.items():
        done = undistort_video(source, tmp_path / f"out{suffix}", lens=lens(), focal=20.0)
        assert done.not_kept == names
    assert told(tmp_path / "out.mkv") == told(source)
    alone = spoken(tmp_path / "one.mkv", [({"language": "eng"}, marks.default)])
    assert undistort_video(alone, tmp_path / "one.ts", lens=lens(), focal=20.0).not_kept == ()


@pytest.mark.parametrize("codec", ["aac", "ac3", "pcm_s16le", "flac"])
def test_sound_of_transport_streams_is_heard_or_refused(codec, tmp_path):
    """FFmpeg writes any into them, as data if they have no number for it, and that was called kept."""
    source = spoken(tmp_path / "in.mkv", [({}, av.stream.Disposition.default)], codec)
    target = tmp_path / "out.ts"
    if codec in ("aac", "ac3"):
        undistort_video(source, target, lens=lens(), focal=20.0)
        with av.open(str(target)) as made:
            assert made.streams.audio[0].codec_context.codec.canonical_name == codec
    else:
        with pytest.raises(
            ValueError, match=rf"Cannot keep the sound \({codec}\) in a \.ts file.*, \.mkv, or"
        ):
            undistort_video(source, target, lens=lens(), focal=20.0)
        assert not target.exists()


@pytest.mark.parametrize("encoder", ["ffv1", "libvpx-vp9", "png", "mpeg4"])
def test_pictures_of_transport_streams_are_seen_or_refused(encoder, tmp_path):
    """As of sound, FFmpeg makes data of them: the result had no pictures, without a word."""
    source, target = clip(tmp_path / "in.mkv"), tmp_path / "out.ts"
    if encoder == "mpeg4":
        undistort_video(source, target, lens=lens(), focal=20.0, encoder=encoder)
        with decode_video(target) as (_, frames):
            assert len(list(frames)) == 4
    else:
        with pytest.raises(
            ValueError, match=r"to a \.ts file.*leave out argument encoder, or choose \.mkv"
        ):
            undistort_video(source, target, lens=lens(), focal=20.0, encoder=encoder)
        assert not target.exists()


@pytest.mark.parametrize("late", [0.05, 1.5])
def test_sound_that_begins_late_is_not_for_avi(late, tmp_path):
    """As of a broadcast, whose times do not begin at 0: it was ahead of the pictures, without a word."""
    target = tmp_path / "out.avi"
    source = spoken(tmp_path / "in.mkv", [({}, av.stream.Disposition.default)], "pcm_s16le", late)
    if late < 0.1:
        undistort_video(source, target, lens=lens(), focal=20.0)
        return
    with pytest.raises(
        ValueError, match=r"begins at 1\.50 s, which a \.avi file does not hold.*Choose \.mkv"
    ):
        undistort_video(source, target, lens=lens(), focal=20.0)
    assert not target.exists()


def sounding(path, codec):
    """A video with two seconds of a tone, and when the last packet of it begins."""
    with av.open(str(path), "w") as out:
        video = out.add_stream("mpeg4", rate=25)
        (video.width, video.height), video.pix_fmt = SIZE, "yuv420p"
        sound = out.add_stream(codec, rate=44100, layout="stereo")
        grey = av.VideoFrame.from_ndarray(np.resize(picture(0), SIZE[::-1]), "gray")
        out.mux([*video.encode(grey.reformat(format="yuv420p")), *video.encode(None)])
        resampled = av.AudioResampler(sound.format, sound.layout, 44100, sound.frame_size or 1024)
        tone = np.sin(np.arange(88200) / 9)[None].astype(np.float32)
        frame = av.AudioFrame.from_ndarray(tone, "fltp", "mono")
        frame.sample_rate, frame.pts = 44100, 0
        for part in resampled.resample(frame):
            out.mux(sound.encode(part))
        out.mux(sound.encode(None))
    return path, packets(path, "audio")[-1][0]


@pytest.mark.parametrize(
    ("codec", "before", "advice"),
    [
        ("ac3", ".avi", None),
        ("aac", ".avi", None),
        ("mp2", ".mkv", None),
        ("eac3", ".mkv", r"Choose \.mkv, or give the sound another format first: ffmpeg"),
        ("adpcm_ms", ".avi", r"\. Give the sound another format first: ffmpeg"),
    ],
)
def test_sound_keeps_its_times_in_avi_or_is_refused(codec, before, advice, tmp_path):
    """FFmpeg copied AC-3 and AAC of AVI files so that seconds passed in tenths, and ADPCM in minutes.

    What some FFmpeg does wrong another may do right, as PyAV 19's with ADPCM.
    """
    source, end = sounding(tmp_path / f"in{before}", codec)
    assert 1.8 < end < 2.1
    refused = None
    try:
        undistort_video(source, tmp_path / "out.avi", lens=lens(), focal=20.0)
    except ValueError as error:
        refused = str(error)
    if refused is None:
        assert packets(tmp_path / "out.avi", "audio")[-1][0] == pytest.approx(end, abs=0.05)
        return
    assert advice is not None, refused
    assert re.search(rf"Cannot keep the sound \({codec}\) in a \.avi file.*{advice}", refused)
    assert not (tmp_path / "out.avi").exists()


def test_a_suffix_that_was_chosen_is_not_advised(tmp_path):
    source, _ = sounding(tmp_path / "in.avi", "adpcm_ms")
    with pytest.raises(ValueError, match=r"in a \.mkv file\. Choose the suffix of the source, or give the"):
        undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=20.0)


def test_what_is_new_to_pyav_in_a_frame_is_said(tmp_path):
    """EXIF data of TIFF pictures: the error was "31 is not a valid Type"."""
    source = clip(tmp_path / "in.mov", encoder="tiff", pixels="rgb24")
    done = undistort_video(source, tmp_path / "out.mov", lens=lens(), focal=20.0)
    with decode_video(tmp_path / "out.mov") as (_, frames):
        assert len(list(frames)) == 4
    with av.open(str(source)) as container:
        frame = next(container.decode(video=0))
        try:
            assert len(frame.side_data) >= 0
        except ValueError:
            assert "what its pictures hold beside the pixels" in done.not_kept

    class Turned:
        """A frame of which as little can be read, and that players turn."""

        rotation = -90

        @property
        def side_data(self):
            raise ValueError("31 is not a valid Type")

    with pytest.raises(ValueError, match="Players turn this video, and PyAV cannot read how"):
        side_data(Turned(), None)


APPLE = {f"com.apple.quicktime.{name}": name for name in ("make", "model", "location.ISO6709")}


@pytest.mark.parametrize(
    ("tags", "suffix", "lost"),
    [
        (APPLE | {"title": "Match"}, ".mov", ()),
        (APPLE, ".mp4", ()),
        (APPLE, ".mkv", ()),
        ({"title": "Match", "camera": "7"}, ".mp4", ("the tag camera",)),
        ({"title": "Match", "artist": "A"}, ".ts", ("the tags title, artist",)),
    ],
)
def test_tags_that_a_container_does_not_hold_are_said(tmp_path, tags, suffix, lost):
    source = clip(tmp_path / "plain.mp4")
    made = av.open(str(tmp_path / "in.mov"), "w", container_options={"movflags": "use_metadata_tags"})
    with av.open(str(source)) as plain, made as out:
        out.metadata.update(tags)
        stream = out.add_stream_from_template(plain.streams.video[0])
        for packet in plain.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    done = undistort_video(tmp_path / "in.mov", tmp_path / f"out{suffix}", lens=lens(), focal=20.0)
    assert done.not_kept == lost
    with av.open(str(tmp_path / f"out{suffix}")) as out:
        there = {name.lower(): value for name, value in out.metadata.items()}
    missing = [name for name in tags if there.get(name.lower()) != tags[name]]
    assert len(missing) == sum(name.count(",") + 1 for name in lost)


@pytest.mark.parametrize(
    ("suffix", "told"), [(".mp4", True), (".mkv", True), (".avi", False), (".ts", False)]
)
def test_an_orientation_that_a_container_does_not_tell_is_said(tmp_path, suffix, told):
    source, quarter = clip(tmp_path / "plain.mp4"), [0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30]
    with av.open(str(source)) as plain, av.open(str(tmp_path / "in.mp4"), "w") as out:
        stream = out.add_stream_from_template(plain.streams.video[0])
        stream.set_display_matrix(quarter)
        for packet in plain.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    done = undistort_video(tmp_path / "in.mp4", tmp_path / f"out{suffix}", lens=lens(), focal=20.0)
    assert done.not_kept == (() if told else ("the orientation: players show it as it is stored",))
    with av.open(str(tmp_path / f"out{suffix}")) as out:
        assert (next(out.decode(video=0)).rotation != 0) == told


def test_data_of_transport_streams_go_over(tmp_path):
    with av.open(str(tmp_path / "in.ts"), "w", format="mpegts") as out:
        video, data = out.add_stream("libx264", rate=25), out.add_data_stream("klv")
        video.width, video.height = SIZE
        video.pix_fmt, data.time_base = "yuv420p", Fraction(1, 90000)
        for number in range(10):
            frame = av.VideoFrame.from_ndarray(picture(number), "gray").reformat(format="yuv420p")
            frame.pts = number
            out.mux(video.encode(frame))
            packet = av.Packet(b"zoom %d" % number)
            packet.stream, packet.time_base = data, Fraction(1, 90000)
            packet.pts = packet.dts = 3600 * number
            out.mux(packet)
        out.mux(video.encode(None))
    done = undistort_video(tmp_path / "in.ts", tmp_path / "out.ts", lens=lens(), focal=20.0)
    assert (done.frames, done.kept, done.not_kept) == (10, ("data (klv)",), ())
    found = packets(tmp_path / "out.ts", "data")
    assert [content for _, content in found] == [b"zoom %d" % number for number in range(10)]
    assert len(luma(tmp_path / "out.ts")[0]) == 10
    done = undistort_video(tmp_path / "in.ts", tmp_path / "out.mp4", lens=lens(), focal=20.0)
    assert done.not_kept == ("data (klv)",)


def test_the_time_code_goes_over(tmp_path):
    with av.open(str(tmp_path / "in.mov"), "w") as out:
        video = out.add_stream("libx264", rate=25)
        video.width, video.height = SIZE
        video.pix_fmt, video.metadata["timecode"] = "yuv420p", "01:02:03:04"
        for number in range(3):
            frame = av.VideoFrame.from_ndarray(picture(number), "gray").reformat(format="yuv420p")
            out.mux(video.encode(frame))
        out.mux(video.encode(None))
    for name in ("out.mov", "out.mp4"):
        done = undistort_video(tmp_path / "in.mov", tmp_path / name, lens=lens(), focal=20.0)
        assert done.kept == ("the time code 01:02:03:04",)
        with av.open(str(tmp_path / name)) as out:
            assert out.streams.data[0].metadata["timecode"] == "01:02:03:04"


MASTERING = "G(13250,34500)B(7500,3000)R(34000,16000)WP(15635,16450)L(10000000,50)"
HDR = {
    "libx265": {"x265-params": f"log-level=error:master-display={MASTERING}:max-cll=1000,400"},
    "libx264": {"x264-params": f"mastering-display={MASTERING}:cll=1000,400"},
    "libsvtav1": {
        "svtav1-params": "mastering-display=G(0.265,0.69)B(0.15,0.06)R(0.68,0.32)WP(0.3127,0.329)"
        "L(1000.0,0.005):content-light=1000,400"
    },
}


def hdr(path):
    """Numbers of the mastering display, as real ones, and of the light level."""
    with av.open(str(path)) as container:
        found = side_data(next(container.decode(video=0)), container.streams.video[0].codec_context)
    numbers = struct.unpack("<22i", found["MASTERING_DISPLAY_METADATA"])
    display = [a / b for a, b in zip(numbers[:20:2], numbers[1:20:2], strict=True)]
    return display, struct.unpack("<2I", found["CONTENT_LIGHT_LEVEL"])


@pytest.mark.parametrize("encoder", HDR)
def test_mastering_metadata_are_kept(tmp_path, encoder):
    source = clip(tmp_path / "in.mkv", encoder=encoder, pixels="yuv420p10le", options=HDR[encoder])
    done = undistort_video(source, tmp_path / "out.mp4", lens=lens(), focal=20.0)
    assert done.kept == ("the mastering display", "the content light level")
    before, after = hdr(source), hdr(tmp_path / "out.mp4")
    np.testing.assert_allclose(after[0], before[0], atol=3e-4)
    np.testing.assert_allclose(
        before[0], [0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329, 0.005, 1000], atol=1e-3
    )
    assert before[1] == after[1] == (1000, 400)


def test_mastering_metadata_that_an_encoder_does_not_write_are_said(tmp_path):
    source = clip(tmp_path / "in.mkv", encoder="libx265", pixels="yuv420p10le", options=HDR["libx265"])
    done = undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=20.0, encoder="ffv1")
    assert done.not_kept == ("the mastering display", "the content light level")


@pytest.mark.parametrize("profile", ["Proxy", "LT", "Standard", "HQ"])
def test_the_profile_of_prores_is_kept(tmp_path, profile):
    number = ["Proxy", "LT", "Standard", "HQ"].index(profile)
    options = {"profile": str(number)}
    source = clip(tmp_path / "in.mov", encoder="prores_ks", pixels="yuv422p10le", options=options)
    undistort_video(source, tmp_path / "out.mov", lens=lens(), focal=20.0)
    with av.open(str(tmp_path / "out.mov")) as out:
        assert out.streams.video[0].codec_context.profile == profile


@pytest.mark.parametrize("encoder", ["libx264", "libx265"])
def test_frames_of_equal_times_are_moved_by_a_tick(tmp_path, encoder):
    """A file of FFV1, whose packets are their own key frames, with two frames at one time."""
    plain = clip(tmp_path / "plain.mkv", encoder="ffv1", stamps=range(6))
    with av.open(str(plain)) as given, av.open(str(tmp_path / "in.mkv"), "w") as out:
        stream = out.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                if packet.pts == 120:
                    packet.pts = packet.dts = 80
                out.mux(packet)
    assert np.diff(luma(tmp_path / "in.mkv")[1]).min() == 0
    options = {"x265-params": "log-level=error"} if encoder == "libx265" else {}
    done = undistort_video(
        tmp_path / "in.mkv", tmp_path / "out.mkv", lens=lens(), focal=20.0, encoder=encoder, options=options
    )
    frames, times = luma(tmp_path / "out.mkv")
    assert len(frames) == done.frames == 6
    assert np.diff(times).min() > 0
    np.testing.assert_allclose(times, luma(tmp_path / "in.mkv")[1], atol=0.0021)
    assert "times of 1 frames, which others had before them" in done.not_kept


@pytest.mark.parametrize("encoder", ["libx264", "mpeg4"])
@pytest.mark.parametrize(("first", "between"), [(0, "3"), (0, "0"), (3, "0")])
def test_frames_of_avi_files_have_the_times_at_which_they_are_shown(tmp_path, encoder, first, between):
    """Such files tell the order of decoding alone. A later beginning fills them after the first frame."""
    options = {"bf": between} | ({"x264-params": "log-level=error"} if encoder == "libx264" else {})
    source = clip(tmp_path / "in.avi", encoder=encoder, stamps=range(first, first + 24), options=options)
    expected = np.array([0, *range(first + 1, first + 24)]) / 25
    with decode_video(source) as (announced, frames):
        found = [(number, time, image()) for number, time, image in frames]
    assert announced >= len(found) == 24
    np.testing.assert_allclose([time for _, time, _ in found], expected, atol=1e-6)
    for number, (counted, _, image) in enumerate(found):
        assert counted == number
        assert np.median(np.abs(image[..., 0].astype(int) - picture(first + number))) < 12
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # "the file ends early"
        done = undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=20.0)
    assert (done.frames, done.lost) == (24, 0)
    assert not any("times" in name for name in done.not_kept)
    times = luma(tmp_path / "out.mkv")[1]
    np.testing.assert_allclose(times - times[0], expected, atol=1e-6)


@pytest.mark.parametrize(("encoder", "between"), [("libx264", 3), ("libx264", 0), ("mpeg2video", 2)])
def test_frames_of_mxf_files_have_the_times_at_which_they_are_shown(tmp_path, encoder, between):
    """Those of H.264 have no index of the order in which frames are shown."""
    source = clip(tmp_path / "in.mxf", encoder=encoder, stamps=range(24), options={"bf": str(between)})
    expected = np.arange(24) / 25
    with decode_video(source) as (_, frames):
        found = [(time, image()) for _, time, image in frames]
    np.testing.assert_allclose([time for time, _ in found], expected, atol=1e-6)
    for number, (_, image) in enumerate(found):
        assert np.median(np.abs(image[..., 0].astype(int) - picture(number))) < 12
    done = undistort_video(source, tmp_path / "out.mkv", lens=lens(), focal=20.0)
    assert not any("times" in name for name in done.not_kept)
    np.testing.assert_allclose(luma(tmp_path / "out.mkv")[1], expected, atol=1e-6)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".webm"])
def test_av1_stays_what_it_is_and_is_called_so(tmp_path, suffix):
    """Whichever library decodes it."""
    source = clip(tmp_path / "in.mkv", encoder="libsvtav1", stamps=range(3))
    done = undistort_video(source, tmp_path / f"out{suffix}", lens=lens(), focal=20.0)
    with av.open(str(tmp_path / f"out{suffix}")) as out:
        assert out.streams.video[0].codec_context.codec.canonical_name == "av1"
    assert done.not_kept == ()
    done = undistort_video(source, tmp_path / "out.mov", lens=lens(), focal=20.0)
    assert done.not_kept == ("the format av1, which became H.264 in a .mov file",)


@pytest.mark.parametrize(("encoder", "expected"), [("libx264", "h264"), ("prores_ks", "prores")])
def test_mxf_is_written(tmp_path, encoder, expected):
    pixels = "yuv420p" if encoder == "libx264" else "yuv422p10le"
    source = clip(tmp_path / "in.mov", encoder=encoder, pixels=pixels)
    done = undistort_video(source, tmp_path / "out.mxf", lens=lens(), focal=20.0)
    assert done.frames == 4
    with av.open(str(tmp_path / "out.mxf")) as out:
        assert out.format.name == "mxf"
        assert out.streams.video[0].codec_context.name == expected
    (before, times), (after, those) = (luma(tmp_path / name) for name in ("in.mov", "out.mxf"))
    np.testing.assert_allclose(those, times, atol=1e-6)
    assert np.median(abs(after[0].astype(int) - zj.undistort_image(before[0], lens()(20.0)))) <= 2


def test_sound_that_mxf_does_not_take_is_a_sentence(tmp_path):
    source = write_clip(tmp_path / "in.mp4", 4)
    with pytest.raises(ValueError, match=r"sound.*aac.*\.mxf.*Choose .*\.mkv"):
        undistort_video(source, tmp_path / "out.mxf", lens=lens(), focal=20.0)
    assert [path.name for path in tmp_path.iterdir()] == ["in.mp4"]


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".mov", ".ts"])
@pytest.mark.parametrize("encoder", ["libvpx-vp9", "mjpeg"])
def test_odd_sizes_are_kept(tmp_path, encoder, suffix):
    size = (SIZE[0] + 1, SIZE[1] + 1)
    pixels = "yuvj420p" if encoder == "mjpeg" else "yuv420p"
    source = clip(tmp_path / "in.mkv", encoder=encoder, pixels=pixels, size=size, stamps=range(2))
    done = undistort_video(source, tmp_path / f"out{suffix}", lens=lens(size), focal=20.0)
    assert luma(tmp_path / f"out{suffix}")[0].shape == (2, *size[::-1])
    changed = any("became yuv444p" in name or "became yuvj444p" in name for name in done.not_kept)
    assert changed == (encoder == "mjpeg" or suffix in (".ts", ".mov"))
    became = any("which became H.264" in name for name in done.not_kept)
    assert became == changed


def test_transport_streams_are_written(tmp_path):
    source = write_clip(tmp_path / "in.ts")
    done = undistort_video(source, tmp_path / "out.ts", lens=lens(), focal=20.0)
    assert done.frames == FRAMES
    assert packets(tmp_path / "out.ts", "audio") == packets(source, "audio")
    assert len(luma(tmp_path / "out.ts")[0]) == FRAMES


def test_back_is_where_it_began(tmp_path):
    source = clip(tmp_path / "in.mkv", encoder="ffv1")
    track = zj.io.FocalTrack(np.array([0.0, 3.0]), np.array([20.0, 80.0]), by_time=False)
    arguments = {"lens": lens(), "focal": track, "keep": "grow", "interpolation": "cubic"}
    undistort_video(source, tmp_path / "out.mkv", **arguments)
    redistort_video(tmp_path / "out.mkv", tmp_path / "back.mkv", **arguments)
    before, grown, after = (luma(tmp_path / name)[0] for name in ("in.mkv", "out.mkv", "back.mkv"))
    assert grown.shape[1] > before.shape[1]
    assert after.shape == before.shape
    difference = np.abs(after.astype(int) - before)[:, 3:-3, 3:-3]
    assert np.percentile(difference, 99) <= 6
    assert difference.mean() < 0.5
    with pytest.raises(ValueError, match="with which it was corrected"):
        redistort_video(source, tmp_path / "no.mkv", **arguments)


@pytest.mark.parametrize("encoder", ["libx264", "libx265", "libvpx-vp9", "prores_ks", "ffv1"])
@pytest.mark.parametrize("correct", [undistort_video, redistort_video])
def test_options_that_an_encoder_does_not_know_are_refused(tmp_path, encoder, correct):
    """FFmpeg passes over them: of a misspelled quality nobody would hear."""
    source = clip(tmp_path / "in.mkv")
    for options in ({"nonsense": "1"}, {"crff": "20", "threads": "1"}, {"movflags": "faststart"}):
        with pytest.raises(ValueError, match=f"of the encoder {encoder}.*'{next(iter(options))}'"):
            correct(source, tmp_path / "out.mkv", lens=lens(), focal=20.0, encoder=encoder, options=options)
    assert [path.name for path in tmp_path.iterdir()] == ["in.mkv"]
    done = correct(
        source, tmp_path / "out.mkv", lens=lens(), focal=20.0, encoder=encoder, options={"threads": "1"}
    )
    assert done.frames == 4


@pytest.mark.parametrize("options", [{"crf": 20}, {20: "crf"}, ["crf", "20"], "crf=20"])
def test_options_are_texts_by_names(tmp_path, options, unchecked):
    with pytest.raises(TypeError, match="options must be texts by names"):
        undistort_video("in.mkv", tmp_path / "out.mkv", lens=lens(), focal=20.0, options=options)


@pytest.mark.parametrize(
    ("encoder", "options", "word"),
    [
        ("libx264", {"x264-params": "keynit=10:crf=18"}, "keynit"),
        ("libx265", {"x265-params": "keynit=10:log-level=error"}, "keynit"),
    ],
    ids=["x264", "x265"],
)
def test_words_within_an_option_that_an_encoder_does_not_know_are_refused(tmp_path, encoder, options, word):
    source = clip(tmp_path / "in.mp4")
    target = tmp_path / "out.mp4"
    with pytest.raises(ValueError, match=f"options must be those of the encoder {encoder}, .*{word}"):
        undistort_video(source, target, lens=lens(), focal=20.0, encoder=encoder, options=options)
    assert not target.exists()


def test_options_within_an_option_reach_the_encoder(tmp_path):
    source = clip(tmp_path / "in.mp4", stamps=range(24))
    sizes = []
    for crf in ("1", "51"):
        target = tmp_path / f"{crf}.mp4"
        options = {"x264-params": f"crf={crf}"}
        undistort_video(source, target, lens=lens(), focal=20.0, encoder="libx264", options=options)
        sizes.append(target.stat().st_size)
    assert sizes[0] > 1.2 * sizes[1]
