"""Photographs from file to file: pixels, depths, metadata, orientation, focal lengths, and mistakes."""

import warnings

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image

import zoomjax as zj
from zoomjax.correct.photo import photo_focal
from zoomjax.io.metadata import Metadata, framing_of, marked
from zoomjax.io.photo import read_focal, read_pages, read_photo
from zoomjax.io.png import with_chunks
from zoomjax.io.tiff import encode_tiff

from .._exif import exif

SIZE = (192, 128)


def lens(size=SIZE, unit="mm"):
    zoom = zj.PolynomialZoom(1, jnp.array([[-0.17, 0.02], [0.43, -0.02]]), jnp.array(20.0))
    return zj.ZoomLens(zoom, (jnp.array(size) - 1) / 2, jnp.array([20.0, 80.0]), size, unit)


def picture(rng, channels=3, dtype=np.uint8):
    noise = cv2.GaussianBlur(rng.uniform(size=(SIZE[1], SIZE[0], max(channels, 1))), (0, 0), 3)
    noise = (noise - noise.min()) / np.ptp(noise)
    top = 1 if np.dtype(dtype).kind == "f" else np.iinfo(dtype).max
    return np.squeeze((noise * top).astype(dtype))


def write(path, image, block=None, profile=None):
    kinds, blocks = [], []
    if block is not None:
        kinds, blocks = [cv2.IMAGE_METADATA_EXIF], [np.frombuffer(block, np.uint8)]
    if profile is not None:
        kinds.append(cv2.IMAGE_METADATA_ICCP)
        blocks.append(np.frombuffer(profile, np.uint8))
    if kinds:
        done, content = cv2.imencodeWithMetadata(path.suffix, image, kinds, blocks)
    else:
        done, content = cv2.imencode(path.suffix, image)
    assert done
    path.write_bytes(content.tobytes())
    return path


def metadata(path):
    image, kinds, blocks = cv2.imreadWithMetadata(str(path), flags=cv2.IMREAD_UNCHANGED)
    return image, {kind: bytes(np.asarray(b, np.uint8)) for kind, b in zip(kinds, blocks, strict=True)}


@pytest.mark.parametrize(
    ("suffix", "channels", "dtype"),
    [
        (".png", 1, np.uint8),
        (".png", 3, np.uint16),
        (".png", 4, np.uint8),
        (".png", 4, np.uint16),
        (".tif", 3, np.uint16),
        (".tif", 3, np.float32),
        (".bmp", 3, np.uint8),
        (".webp", 4, np.uint8),
    ],
)
def test_depth_and_channels_are_kept(tmp_path, rng, suffix, channels, dtype):
    source = write(tmp_path / f"in{suffix}", picture(rng, channels, dtype))
    zj.undistort_photo(source, tmp_path / f"out{suffix}", lens=lens(), focal=20.0)
    before, after = (
        cv2.imread(str(tmp_path / f"{n}{suffix}"), cv2.IMREAD_UNCHANGED) for n in ("in", "out")
    )
    expected = zj.undistort_image(before, lens()(20.0))
    assert after.dtype == dtype
    seen = expected[..., 3] > 0 if channels == 4 else ...  # lossless WebP drops colours nobody sees
    np.testing.assert_array_equal(after[seen], expected[seen])


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_metadata_are_kept_and_orientation_does_not_turn_pixels(tmp_path, rng, suffix):
    block = exif((3500, 100), orientation=6)
    source = write(tmp_path / f"in{suffix}", picture(rng), block)
    zj.undistort_photo(source, tmp_path / f"out{suffix}", lens=lens())  # 35 mm, from the EXIF data
    before, _ = metadata(source)
    after, kept = metadata(tmp_path / f"out{suffix}")
    assert kept[cv2.IMAGE_METADATA_EXIF].endswith(block)
    assert after.shape == (SIZE[1], SIZE[0], 3)
    difference = cv2.absdiff(after, zj.undistort_image(before, lens()(35.0)))
    assert difference.mean() < 1  # JPEG in quality 97
    turned = cv2.imread(str(tmp_path / f"out{suffix}"))  # as viewers do
    if suffix == ".jpg":
        assert turned.shape == (SIZE[0], SIZE[1], 3)


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_colour_profile_is_kept(tmp_path, rng, suffix):
    profile = bytes(range(256)) * 2  # OpenCV checks those of PNG files, and passes these on
    source = write(tmp_path / f"in{suffix}", picture(rng), exif(), profile)
    zj.undistort_photo(source, tmp_path / f"out{suffix}", lens=lens())
    assert metadata(tmp_path / f"out{suffix}")[1][cv2.IMAGE_METADATA_ICCP] == profile


def test_tiff_tells_its_focal_length_if_it_knows(tmp_path, rng):
    source = write(tmp_path / "in.tif", picture(rng))
    with pytest.raises(ValueError, match=r"focal length of .*in\.tif is not known.*argument focal"):
        photo_focal(source, lens())


TIFF_AND_OTHERS = [(".tif", ".jpg"), (".jpg", ".tif"), (".tif", ".tiff"), (".png", ".tif")]


@pytest.mark.parametrize("suffixes", TIFF_AND_OTHERS)
def test_tiff_files_take_and_give_metadata(tmp_path, rng, suffixes):
    block, image = exif((3500, 100), orientation=6), picture(rng)
    source, target = (tmp_path / f"{name}{suffix}" for name, suffix in zip("ab", suffixes, strict=True))
    if suffixes[0] == ".tif":
        source.write_bytes(encode_tiff([(image, Metadata(exif=block))]))
    else:
        write(source, image, block)
    zj.undistort_photo(source, target, lens=lens())  # 35 mm, from the EXIF data
    assert read_focal(target) == 35.0
    stored, _ = read_photo(target)
    expected = zj.undistort_image(read_photo(source)[0], lens()(35.0))
    assert cv2.absdiff(stored, expected).mean() < 1  # JPEG in quality 97
    upright = cv2.imdecode(np.fromfile(target, np.uint8), cv2.IMREAD_COLOR)  # as viewers show it
    assert upright.shape == (SIZE[0], SIZE[1], 3)


def test_what_has_no_room_for_metadata_says_so(tmp_path, rng):
    source = write(tmp_path / "in.png", picture(rng), exif())
    with pytest.warns(UserWarning, match=r"Not kept of .*in\.png in a \.bmp file: EXIF data\."):
        zj.undistort_photo(source, tmp_path / "out.bmp", lens=lens())


def wrong(case, tmp_path, rng):
    """Arguments of a call that must fail, and what it must say."""
    good = write(tmp_path / "in.jpg", picture(rng), exif())
    deep = write(tmp_path / "deep.png", picture(rng, 3, np.uint16))
    clear = write(tmp_path / "clear.png", picture(rng, 4))
    bare = write(tmp_path / "bare.jpg", picture(rng))
    (tmp_path / "damaged.jpg").write_bytes(good.read_bytes()[:300])
    (tmp_path / "empty.jpg").write_bytes(b"")
    out = tmp_path / "out.jpg"
    return {
        "missing": (tmp_path / "none.jpg", out, {}, FileNotFoundError, "no photograph"),
        "empty": (tmp_path / "empty.jpg", out, {}, ValueError, r"Cannot read a photograph from .*empty"),
        "damaged": (tmp_path / "damaged.jpg", out, {}, ValueError, "damaged"),
        "suffix": (good, tmp_path / "out.gif", {}, ValueError, r"must end in one of \.jpg"),
        "16 bits": (deep, out, {"focal": 30.0}, ValueError, r"3 channels of 16 bits.*choose \.png"),
        "alpha": (clear, out, {"focal": 30.0}, ValueError, r"4 channels of 8 bits"),
        "no EXIF": (bare, out, {}, ValueError, "its EXIF data have none in mm"),
        "px": (good, out, {"lens": lens(unit="px")}, ValueError, "its EXIF data have none in px"),
        "aspect": (good, out, {"lens": lens((128, 192))}, ValueError, "another aspect ratio"),
        "folder": (good, tmp_path / "no" / "out.jpg", {}, OSError, "cannot write in the folder"),
    }[case]


CASES = ("missing", "empty", "damaged", "suffix", "16 bits", "alpha", "no EXIF", "px", "aspect", "folder")


@pytest.mark.parametrize("case", CASES)
def test_mistakes_are_named_and_leave_nothing(case, tmp_path, rng):
    source, target, arguments, error, message = wrong(case, tmp_path, rng)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(error, match=message):
        zj.undistort_photo(source, target, **{"lens": lens(), **arguments})
    assert sorted(tmp_path.iterdir()) == before


def test_another_size_of_the_same_aspect_is_scaled_and_said(tmp_path, rng):
    source = write(tmp_path / "in.png", picture(rng))
    with pytest.warns(UserWarning, match="its distortion is scaled"):
        zj.undistort_photo(source, tmp_path / "out.png", lens=lens((384, 256)), focal=20.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scaled = zj.models.lens_for_size(lens((384, 256)), SIZE)
    expected = zj.undistort_image(cv2.imread(str(source)), scaled(20.0))
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out.png")), expected)


def test_pages_of_a_tiff_file_are_corrected_each(tmp_path, rng):
    pages = [Image.fromarray(picture(rng)) for _ in range(3)]
    profile = bytes(range(256))
    pages[0].save(tmp_path / "in.tif", save_all=True, append_images=pages[1:], icc_profile=profile)
    zj.undistort_photo(tmp_path / "in.tif", tmp_path / "out.tif", lens=lens(), focal=20.0)
    photo = read_pages(tmp_path / "out.tif")
    assert len(photo.pages) == 3
    for (found, metadata), page in zip(photo.pages, pages, strict=True):
        np.testing.assert_array_equal(found[..., ::-1], zj.undistort_image(np.asarray(page), lens()(20.0)))
        assert metadata.icc == profile
    with pytest.raises(ValueError, match=r"Cannot write .*in\.tif: it has 3 pages.*choose \.tif"):
        zj.undistort_photo(tmp_path / "in.tif", tmp_path / "out.jpg", lens=lens(), focal=20.0)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_tiff_of_any_orientation_is_corrected_as_stored(tmp_path, rng, orientation):
    given, image = Image.Exif(), picture(rng)
    given[ExifTags.Base.Orientation] = orientation
    Image.fromarray(image).save(tmp_path / "in.tif", exif=given, compression="tiff_lzw")
    zj.undistort_photo(tmp_path / "in.tif", tmp_path / "out.tif", lens=lens(), focal=20.0)
    with tifffile.TiffFile(tmp_path / "out.tif") as out:
        np.testing.assert_array_equal(out.asarray(), zj.undistort_image(image, lens()(20.0)))
        assert out.pages[0].tags["Orientation"].value == orientation


def test_colours_of_print_are_refused(tmp_path, rng):
    Image.fromarray(picture(rng)).convert("LAB").save(tmp_path / "in.tif")
    with pytest.raises(ValueError, match=r"in\.tif is in Lab colours, .* convert it to RGB first"):
        zj.undistort_photo(tmp_path / "in.tif", tmp_path / "out.tif", lens=lens(), focal=20.0)
    Image.fromarray(picture(rng)).convert("CMYK").save(tmp_path / "in.jpg")
    with pytest.raises(ValueError, match=r"in\.jpg is in the four colours of print \(CMYK\).* RGB first"):
        zj.undistort_photo(tmp_path / "in.jpg", tmp_path / "out.jpg", lens=lens(), focal=20.0)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".avif"])
def test_what_is_corrected_is_not_corrected_twice(tmp_path, rng, suffix):
    source, once, twice = (tmp_path / f"{name}{suffix}" for name in ("in", "once", "twice"))
    Image.fromarray(picture(rng)).save(source)
    zj.undistort_photo(source, once, lens=lens(), focal=20.0)
    with pytest.raises(ValueError, match=r"once.* is undistorted by zoomjax already.*argument again"):
        zj.undistort_photo(once, twice, lens=lens(), focal=20.0)
    assert not twice.exists()
    zj.undistort_photo(once, twice, lens=lens(), focal=20.0, again=True)
    zj.correct.redistort_photo(once, tmp_path / f"back{suffix}", lens=lens(), focal=20.0)
    zj.undistort_photo(tmp_path / f"back{suffix}", twice, lens=lens(), focal=20.0)


def test_what_another_program_has_corrected_is_told_of(tmp_path, rng):
    xmp = b'<rdf:RDF><a crs:LensProfileEnable="1" crs:AlreadyApplied="True"/></rdf:RDF>'
    Image.fromarray(picture(rng)).save(tmp_path / "in.jpg", xmp=xmp)
    with pytest.warns(UserWarning, match=r"in\.jpg says that Adobe's lens correction has .* twice"):
        zj.undistort_photo(tmp_path / "in.jpg", tmp_path / "out.jpg", lens=lens(), focal=20.0)
    zj.correct.redistort_photo(tmp_path / "in.jpg", tmp_path / "back.jpg", lens=lens(), focal=20.0)


def test_adobe_is_not_left_to_correct_once_more_and_sizes_are_those_of_the_result(tmp_path, rng):
    xmp = (
        b'<rdf:RDF><a crs:LensProfileEnable="1" exif:PixelXDimension="%d" exif:PixelYDimension="%d"/>'
        b"</rdf:RDF>"
    )
    image = picture(rng)
    height, width = image.shape[:2]
    given = Image.Exif()
    given[ExifTags.IFD.Exif] = {ExifTags.Base.ExifImageWidth: width, ExifTags.Base.ExifImageHeight: height}
    Image.fromarray(image).save(tmp_path / "in.jpg", xmp=xmp % (width, height), exif=given)
    with pytest.warns(UserWarning, match=r"Not kept of .*: the order to Adobe's programs"):
        zj.undistort_photo(tmp_path / "in.jpg", tmp_path / "out.jpg", lens=lens(), focal=35.0, keep="grow")
    corrected, metadata = read_photo(tmp_path / "out.jpg")
    assert corrected.shape[1] > width
    with Image.open(tmp_path / "out.jpg") as opened:
        own = opened.getexif().get_ifd(ExifTags.IFD.Exif)
    size = (own[ExifTags.Base.ExifImageWidth], own[ExifTags.Base.ExifImageHeight])
    assert size == corrected.shape[1::-1]
    assert xmp.replace(b'"1"', b'"0"').removesuffix(b"</rdf:RDF>") % size in metadata.xmp


def test_a_damaged_packet_is_named(tmp_path, rng):
    Image.fromarray(picture(rng)).save(tmp_path / "in.jpg", xmp=b"<x:xmpmeta><rdf:RDF><a dc:source=")
    with pytest.warns(UserWarning, match="Not kept of .*: XMP, which is damaged"):
        zj.undistort_photo(tmp_path / "in.jpg", tmp_path / "out.jpg", lens=lens(), focal=35.0)


@pytest.mark.parametrize("keep", ["same", "all", "valid", "grow"])
def test_back_is_where_it_began(tmp_path, rng, keep):
    """Of what is still there: with "grow" everything, at full size."""
    image = cv2.GaussianBlur(picture(rng), (0, 0), 3)
    cv2.imwrite(str(tmp_path / "in.png"), image)
    arguments = {"lens": lens(), "focal": 20.0, "keep": keep, "interpolation": "cubic"}
    zj.undistort_photo(tmp_path / "in.png", tmp_path / "out.png", **arguments)
    zj.correct.redistort_photo(tmp_path / "out.png", tmp_path / "back.png", **arguments)
    back = cv2.imread(str(tmp_path / "back.png"))
    assert back.shape == image.shape
    middle = np.s_[30:-30, 40:-40] if keep in ("same", "valid") else np.s_[2:-2, 2:-2]
    assert np.abs(back[middle].astype(int) - image[middle]).max() <= 4
    wrong = cv2.imread(str(tmp_path / "out.png"))[: SIZE[1], : SIZE[0]]
    assert np.abs(wrong[middle].astype(int) - image[middle]).max() > 10


@pytest.mark.parametrize("keep", ["same", "all"])
def test_another_framing_than_the_one_it_was_corrected_with_is_refused(tmp_path, rng, keep):
    """Of the same size, so that only the mark tells."""
    cv2.imwrite(str(tmp_path / "in.png"), picture(rng))
    common = zj.correct.frame_output(lens(), SIZE, keep="all")
    zj.undistort_photo(tmp_path / "in.png", tmp_path / "out.png", lens=lens(), focal=20.0, keep=common)
    with pytest.raises(ValueError, match="was corrected with another framing"):
        zj.correct.redistort_photo(
            tmp_path / "out.png", tmp_path / "back.png", lens=lens(), focal=80.0, keep=keep
        )
    assert not (tmp_path / "back.png").exists()
    zj.correct.redistort_photo(
        tmp_path / "out.png", tmp_path / "back.png", lens=lens(), focal=80.0, keep=common
    )


def test_signed_numbers_are_refused_where_the_format_has_none(tmp_path, rng):
    signed = (picture(rng, 1, np.uint16).astype(np.int32) - 30000).astype(np.int16)
    tifffile.imwrite(tmp_path / "in.tif", signed, photometric="minisblack")
    with pytest.raises(ValueError, match=r"signed numbers, which a \.png file does not hold: choose \.tif"):
        zj.undistort_photo(tmp_path / "in.tif", tmp_path / "out.png", lens=lens(), focal=20.0)
    assert not (tmp_path / "out.png").exists()
    zj.undistort_photo(tmp_path / "in.tif", tmp_path / "out.tif", lens=lens(), focal=20.0)
    assert tifffile.imread(tmp_path / "out.tif").min() < 0


@pytest.mark.parametrize("mode", ["L", "I;16"])
def test_transparent_grey_of_png_files_stays_so(tmp_path, mode):
    grey = np.full((SIZE[1], SIZE[0]), 90, np.uint8 if mode == "L" else np.uint16)
    grey[40:80, 60:120] = 106
    Image.fromarray(grey).save(tmp_path / "in.png", transparency=106)
    image, _ = read_photo(tmp_path / "in.png")
    most = np.iinfo(grey.dtype).max
    np.testing.assert_array_equal(image[..., 3], np.where(grey == 106, 0, most))
    np.testing.assert_array_equal(image[..., 0], grey)


def test_a_profile_of_greys_does_not_go_with_colours(tmp_path):
    profile = bytes(16) + b"GRAY" + bytes(108)
    grey = Image.fromarray(np.full((SIZE[1], SIZE[0]), 90, np.uint8))
    grey.convert("LA").save(tmp_path / "in.png", icc_profile=profile)
    with pytest.warns(UserWarning, match="the colour profile"):
        zj.undistort_photo(tmp_path / "in.png", tmp_path / "out.png", lens=lens(), focal=20.0)
    with Image.open(tmp_path / "out.png") as written:
        assert "icc_profile" not in written.info


def test_chunks_of_another_format_are_named(tmp_path, rng):
    plain = write(tmp_path / "plain.png", picture(rng)).read_bytes()
    chunks = Metadata(chunks=((b"cICP", bytes([9, 16, 0, 1])), (b"tEXt", b"Author\0somebody")))
    (tmp_path / "in.png").write_bytes(with_chunks(plain, chunks))
    with pytest.warns(UserWarning, match="the colour space, texts"):
        zj.undistort_photo(tmp_path / "in.png", tmp_path / "out.tif", lens=lens(), focal=20.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        zj.undistort_photo(tmp_path / "in.png", tmp_path / "out.png", lens=lens(), focal=20.0)


@pytest.mark.parametrize("interpolation", ["cubic", "lanczos"])
@pytest.mark.parametrize("k", [-0.12, 0.12])
def test_valid_shows_nothing_of_the_border_under_any_kernel(interpolation, k):
    white = np.full((SIZE[1], SIZE[0]), 1000.0, np.float32)
    d = zj.Distortion(np.array([k]), (np.array(SIZE) - 1) / 2, np.array(np.hypot(*SIZE) / 2))
    corrected = zj.undistort_image(white, d, keep="valid", interpolation=interpolation)
    np.testing.assert_allclose(corrected, 1000.0, rtol=1e-5)


def test_half_floats_do_not_overflow():
    bright = np.zeros((SIZE[1], SIZE[0]), np.float16)
    bright[40:80, 60:120] = np.finfo(np.float16).max
    d = zj.Distortion(np.array([0.1]), (np.array(SIZE) - 1) / 2, np.array(np.hypot(*SIZE) / 2))
    assert np.isfinite(zj.undistort_image(bright, d, interpolation="cubic")).all()


def test_the_mark_gives_the_framing_back_and_none_that_cannot_be():
    def told(shown):
        return framing_of(marked(Metadata(), "undistorted", framing=shown))

    assert told((0.9, -1.5, 1e-7)) == (0.9, -1.5, 1e-7)
    assert told((0.0, 0.0, 0.0)) is None
    assert told(None) is None
