"""Colours and transparency of videos in all pixel formats that are met: the same after correction."""

from fractions import Fraction

import av
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct._planes import planar_format
from zoomjax.correct.video import undistort_video

SIZE = (64, 48)
PATCHES = np.array(
    [[230, 30, 40, 255], [20, 200, 60, 255], [30, 60, 220, 0], [128, 128, 128, 255]], np.uint8
)


def straight():
    """A lens without distortion."""
    zoom = zj.PolynomialZoom(0, jnp.zeros((1, 2)), jnp.array(20.0))
    return zj.ZoomLens(zoom, (jnp.array(SIZE) - 1) / 2, jnp.array([20.0, 80.0]), SIZE)


def coloured(path, encoder, pixels):
    """A clip of four columns of red, green, blue and grey; the third is transparent."""
    shown = np.repeat(PATCHES[None], SIZE[1], axis=0).repeat(SIZE[0] // 4, axis=1)
    with av.open(str(path), "w") as out:
        video = out.add_stream(encoder, rate=25)
        video.width, video.height = SIZE
        full = encoder == "ffv1" and pixels.startswith("yuvj")  # which says so in another way
        video.pix_fmt = pixels.replace("yuvj", "yuv") if full else pixels
        video.codec_context.color_range = 2 if full else 0
        for number in range(3):
            frame = av.VideoFrame.from_ndarray(shown, "rgba").reformat(format=pixels)
            frame = frame.reformat(format=video.pix_fmt, dst_color_range=2) if full else frame
            frame.pts, frame.time_base = number, Fraction(1, 25)
            out.mux(video.encode(frame))
        out.mux(video.encode(None))
    return path


def seen(path):
    """The colours in the middle of the columns, red, green, blue, as players show the first frame."""
    with av.open(str(path)) as clip:
        frame = next(clip.decode(video=0))
        image = frame.to_ndarray(format="rgb24")
    return image[SIZE[1] // 2, SIZE[0] // 8 :: SIZE[0] // 4].astype(int), frame.format.name


@pytest.mark.parametrize(
    ("name", "encoder", "pixels", "target", "made"),
    [
        ("in.mov", "png", "rgb24", "out.mov", None),
        ("in.mov", "png", "rgba", "out.mov", None),
        ("in.mov", "png", "rgb48be", "out.mov", None),
        ("in.mov", "png", "ya8", "out.mov", None),
        ("in.mov", "qtrle", "argb", "out.mov", None),
        ("in.mkv", "libx264rgb", "rgb24", "out.mkv", None),  # as screens are recorded
        ("in.mkv", "libx264rgb", "rgb24", "out.mkv", "libx264rgb"),
        ("in.mkv", "libx264", "yuv444p", "out.mkv", "libx264rgb"),
        ("in.mkv", "libx264", "yuvj444p", "out.mov", "png"),
        ("in.avi", "rawvideo", "bgr24", "out.avi", None),
        (
            "in.mov",
            "png",
            "rgba",
            "out.webm",
            None,
        ),  # transparent, in the only format that VP9 has for that
        ("in.mov", "prores_ks", "yuva444p10le", "out.webm", None),
        (
            "in.avi",
            "rawvideo",
            "gray",
            "out.mp4",
            None,
        ),  # of machine vision: no range is said, and it is full
        ("in.avi", "rawvideo", "gray", "out.mov", "prores_ks"),
        ("in.avi", "rawvideo", "gray", "out.mkv", "ffv1"),
        ("in.avi", "mjpeg", "yuvj420p", "out.mp4", None),
        ("in.avi", "mjpeg", "yuvj420p", "out.mov", "prores_ks"),  # whose range players take for limited
        ("in.avi", "mjpeg", "yuvj420p", "out.mkv", "libvpx"),
        ("in.mkv", "ffv1", "yuvj420p", "out.mkv", None),
        ("in.mkv", "ffv1", "yuvj420p", "out.mp4", None),
        ("in.mkv", "ffv1", "yuvj420p", "out.avi", None),
    ],
)
def test_colours_stay(name, encoder, pixels, target, made, tmp_path):
    """Red, green and blue that become luma and chroma are said to be these, and by which matrix."""
    source = coloured(tmp_path / name, encoder, pixels)
    before, _ = seen(source)
    undistort_video(source, tmp_path / target, lens=straight(), focal=30.0, encoder=made)
    after, _ = seen(tmp_path / target)
    assert np.abs(after - before).max() <= 6


@pytest.mark.parametrize(
    ("target", "made", "kept"),
    [("out.mp4", None, True), ("out.mov", "prores_ks", False), ("out.avi", "mpeg4", False)],
)
def test_a_range_of_values_that_the_encoder_does_not_tell_is_said(target, made, kept, tmp_path):
    source = coloured(tmp_path / "in.avi", "mjpeg", "yuvj420p")
    done = undistort_video(source, tmp_path / target, lens=straight(), focal=30.0, encoder=made)
    assert ("the full range of values, which became the limited one" in done.not_kept) == (not kept)


@pytest.mark.parametrize(("encoder", "pixels"), [("png", "rgba"), ("prores_ks", "yuva444p10le")])
def test_transparency_is_kept_in_webm(encoder, pixels, tmp_path):
    source = coloured(tmp_path / "in.mov", encoder, pixels)
    done = undistort_video(source, tmp_path / "out.webm", lens=straight(), focal=30.0)
    assert "transparency" not in done.not_kept
    with av.open(str(tmp_path / "out.webm")) as clip:
        decoder = av.CodecContext.create("libvpx-vp9", "r")  # FFmpeg's own decodes none
        frame = next(frame for packet in clip.demux(video=0) for frame in decoder.decode(packet))
    alpha = frame.to_ndarray(format="rgba")[SIZE[1] // 2, SIZE[0] // 8 :: SIZE[0] // 4, 3]
    assert (np.abs(alpha.astype(int) - PATCHES[:, 3]) <= 6).all()


@pytest.mark.parametrize(
    ("name", "encoder", "pixels", "target", "kept"),
    [
        ("in.mov", "prores_ks", "yuva444p10le", "out.mov", True),
        ("in.mkv", "ffv1", "yuva420p", "out.mkv", True),
        ("in.mov", "png", "rgba64be", "out.mov", False),  # H.264 holds none
        ("in.webm", "libvpx-vp9", "yuva420p", "out.webm", False),  # which FFmpeg does not decode
        ("in.webm", "libvpx-vp9", "yuv420p", "out.webm", True),  # there is none
    ],
)
def test_transparency_that_is_lost_is_said(name, encoder, pixels, target, kept, tmp_path):
    source = coloured(tmp_path / name, encoder, pixels)
    done = undistort_video(source, tmp_path / target, lens=straight(), focal=30.0)
    assert ("transparency" in done.not_kept) == (not kept)
    with av.open(str(tmp_path / target)) as clip:
        tags = {key.lower() for key in clip.streams.video[0].metadata}
    assert "alpha_mode" not in tags


def test_every_pixel_format_is_warped_in_planes_that_hold_its_channels():
    """Red, green and blue, deep or not, transparency, and one channel stay these."""
    for name in sorted(av.video.format.names):
        given = av.VideoFormat(name, 16, 16)
        if not given.components or given.has_palette:
            continue
        made = av.VideoFormat(planar_format(name), 16, 16)
        assert made.is_rgb == given.is_rgb, name
        alpha = [any(c.is_alpha for c in of.components) for of in (given, made)]
        assert alpha[0] <= alpha[1], name  # some have room for it, and none in it
        assert max(c.bits for c in made.components) >= min(16, max(c.bits for c in given.components)), name
        assert len({c.plane for c in made.components}) == len(made.components), name
        assert (len(given.components) == 1) == (len(made.components) == 1), name
