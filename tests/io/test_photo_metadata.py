"""Metadata from format to format, in files of Pillow and tifffile: what is kept, and what is said."""

import io
import shutil
import struct
import subprocess

import cv2
import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image, IptcImagePlugin, PngImagePlugin
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from zoomjax.io.equipment import exif_equipment, read_equipment
from zoomjax.io.exif import exif_in_srgb, exif_with_orientation, exif_with_size, parse_exif
from zoomjax.io.metadata import (
    Metadata,
    framing_of,
    geometry_of,
    has_no_place,
    marked,
    not_corrected_again,
    squeezed,
    straightened_by,
    with_size,
    work_of,
)
from zoomjax.io.photo import read_focal, read_metadata, read_pages, read_photo, read_size
from zoomjax.io.photo_writer import encoded_photo
from zoomjax.io.raw import raw_metadata

from .._exif import exif

XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description rdf:about="" xmlns:dc="http://purl.org/dc/elements/1.1/" dc:source="a ruler"/>'
    b"</rdf:RDF></x:xmpmeta>"
)
ICC = b"\0\0\0\0" + bytes(range(256)) * 300  # longer than a segment of a JPEG file
IIM = b"\x1c\x02\x78\x00\x05ruler"  # a caption
IPTC = b"8BIM\x04\x04\0\0" + struct.pack(">I", len(IIM)) + IIM
FULL = Metadata(exif=exif(), xmp=XMP, icc=ICC, iptc=IPTC, comment=b"a comment", dpi=(300.0, 300.0))


@pytest.fixture
def image(rng):
    noise = cv2.GaussianBlur(rng.uniform(size=(40, 60, 3)), (0, 0), 3)
    return ((noise - noise.min()) / np.ptp(noise) * 255).astype(np.uint8)


def write(path, image, metadata=FULL):
    content, lost = encoded_photo([(image, metadata)], path.suffix)
    path.write_bytes(content)
    return lost


HELD = {
    ".jpg": {"exif", "xmp", "icc", "iptc", "comment", "dpi"},
    ".png": {"exif", "xmp", "icc", "comment", "dpi"},
    ".tif": {"exif", "xmp", "icc", "iptc", "dpi"},
    ".webp": {"exif", "xmp", "icc"},
    ".avif": {"exif", "xmp", "icc"},
    ".bmp": {"dpi"},
}


@pytest.mark.parametrize("suffix", HELD)
def test_all_that_a_format_holds_comes_back_and_the_rest_is_named(tmp_path, image, suffix):
    lost = write(tmp_path / f"a{suffix}", image)
    found = read_pages(tmp_path / f"a{suffix}").pages[0][1]
    assert read_metadata(tmp_path / f"a{suffix}") == found
    for field in ("xmp", "icc", "iptc", "comment"):
        assert getattr(found, field) == (getattr(FULL, field) if field in HELD[suffix] else b"")
    assert (found.dpi is not None) == ("dpi" in HELD[suffix])
    if found.dpi:
        np.testing.assert_allclose(found.dpi, 300, atol=0.02)  # PNG and BMP count per metre
    assert read_focal(tmp_path / f"a{suffix}") == (35.0 if "exif" in HELD[suffix] else None)
    names = {"exif": "EXIF data", "xmp": "XMP", "icc": "the colour profile", "iptc": "IPTC data"}
    names |= {"comment": "the comment", "dpi": "the resolution"}
    assert set(lost) == {names[field] for field in names.keys() - HELD[suffix]}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".avif"])
def test_other_programs_find_them(tmp_path, image, suffix):
    write(tmp_path / f"a{suffix}", image)
    with Image.open(tmp_path / f"a{suffix}") as opened:
        opened.load()
        assert opened.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] == 35
        assert opened.info["icc_profile"] == ICC
        assert b"a ruler" in (opened.info.get("xmp") or opened.info["XML:com.adobe.xmp"].encode())
        if suffix in (".jpg", ".png", ".tif"):
            assert opened.info["dpi"][0] == pytest.approx(300, abs=0.02)
        if suffix == ".jpg":
            assert opened.info["photoshop"][0x0404] == IIM
            assert opened.info["comment"] == b"a comment"
        if suffix == ".tif":
            assert opened.tag_v2[33723] == IIM
        if suffix == ".png":
            assert opened.text["Comment"] == "a comment"


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
@pytest.mark.parametrize("metadata", [FULL, Metadata()])
def test_colours_under_transparent_pixels_stay(tmp_path, rng, suffix, metadata):
    """WebP files had others there, of which nothing was said."""
    image = rng.integers(0, 256, (40, 60, 4)).astype(np.uint8)
    image[:20, :, 3] = 0
    write(path := tmp_path / f"a{suffix}", image, metadata)
    ((found, told),) = read_pages(path).pages
    np.testing.assert_array_equal(found, image)
    assert (told.xmp, told.icc) == (metadata.xmp, metadata.icc)
    assert read_focal(path) == (35.0 if metadata.exif else None)


def test_a_webp_file_with_transparency_that_is_too_large_is_refused():
    with pytest.raises(ValueError, match=r"it cannot be written as \.webp"):
        encoded_photo([(np.zeros((1, 20_000, 4), np.uint8), Metadata())], ".webp")


def test_what_pillow_writes_is_read(tmp_path, image):
    picture = Image.fromarray(image)
    picture.save(
        tmp_path / "a.jpg",
        dpi=(72, 72),
        comment=b"hello",
        icc_profile=ICC,
        xmp=XMP,
        exif=b"Exif\0\0" + exif(),
    )
    found = read_metadata(tmp_path / "a.jpg")
    assert (found.comment, found.icc, found.xmp, found.exif) == (b"hello", ICC, XMP, exif())
    assert found.dpi == (72, 72)
    text = PngImagePlugin.PngInfo()
    text.add_itxt("XML:com.adobe.xmp", XMP.decode(), zip=True)
    text.add_text("Title", "Edges")
    picture.save(tmp_path / "a.png", pnginfo=text, icc_profile=ICC)
    found = read_metadata(tmp_path / "a.png")
    assert (found.xmp, found.icc) == (XMP, ICC)
    write(tmp_path / "b.png", image, found)
    with Image.open(tmp_path / "b.png") as opened:
        assert opened.text["Title"] == "Edges"


def test_the_film_of_a_motion_photo_is_named_and_no_longer_announced(tmp_path, image):
    """Phones append it to the picture, and say so in the XMP."""
    told = b'<x GCamera:MicroVideo="1" GCamera:MotionPhoto="1" GCamera:MotionPhotoVersion="1"/>'
    Image.fromarray(image).save(tmp_path / "a.jpg", xmp=told)
    still = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "b.jpg").write_bytes(still + b"\0\0\0\x18ftypmp42" + bytes(range(256)))
    (tmp_path / "c.jpg").write_bytes(still + bytes(64))
    for name, others in (("a.jpg", ()), ("b.jpg", ("the film of a motion photo",)), ("c.jpg", ())):
        assert read_pages(tmp_path / name).others == others
        assert (read_metadata(tmp_path / name).xmp == told) == (not others)
    silent = read_metadata(tmp_path / "b.jpg").xmp
    assert silent == b'<x GCamera:MicroVideo="0" GCamera:MotionPhoto="0" GCamera:MotionPhotoVersion="1"/>'


def test_further_pictures_are_named(tmp_path, image):
    pictures = [Image.fromarray(image), Image.fromarray(255 - image)]
    for name, form in (("a.jpg", "MPO"), ("a.png", "PNG"), ("a.webp", "WEBP")):
        pictures[0].save(tmp_path / name, form, save_all=True, append_images=pictures[1:])
        assert read_pages(tmp_path / name).others == ("further pictures",)


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_deflate", "packbits"])
def test_each_page_of_a_tiff_file_is_read(tmp_path, image, compression):
    pages = [Image.fromarray(image), Image.fromarray(255 - image)]
    pages[0].save(
        tmp_path / "a.tif", save_all=True, append_images=pages[1:], compression=compression, icc_profile=ICC
    )
    photo = read_pages(tmp_path / "a.tif")
    for (found, _), page in zip(photo.pages, pages, strict=True):
        np.testing.assert_array_equal(found[..., ::-1], np.asarray(page))
    content, _ = encoded_photo(photo.pages, ".tif")
    with tifffile.TiffFile(io.BytesIO(content)) as again:
        assert len(again.pages) == 2
        assert again.pages[0].tags["InterColorProfile"].value == ICC
        np.testing.assert_array_equal(again.pages[1].asarray(), np.asarray(pages[1]))
    with pytest.raises(ValueError, match=r"2 pages, which a \.jpg file does not hold: choose \.tif"):
        encoded_photo(photo.pages, ".jpg")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_planes_of_a_tiff_file_one_after_the_other_are_colours(tmp_path, image, dtype):
    """OpenCV takes them for interleaved."""
    planes = np.moveaxis(image.astype(dtype), -1, 0)
    tifffile.imwrite(tmp_path / "a.tif", planes, photometric="rgb", planarconfig="separate")
    np.testing.assert_array_equal(read_photo(tmp_path / "a.tif")[0][..., ::-1], image)


def test_transparency_that_a_bmp_file_has_no_place_for_is_named(tmp_path, rng):
    """As Pillow writes it; OpenCV writes a header that has a place."""
    colours = rng.integers(0, 255, (9, 13, 4)).astype(np.uint8)
    opaque = np.dstack([colours[..., :3], np.full((9, 13), 255, np.uint8)])
    for picture, others in ((colours, ("transparency",)), (opaque, ()), (colours[..., :3], ())):
        Image.fromarray(picture).save(tmp_path / "a.bmp")
        photo = read_pages(tmp_path / "a.bmp")
        np.testing.assert_array_equal(photo.pages[0][0], picture[..., 2::-1])
        assert photo.others == others
    cv2.imwrite(str(tmp_path / "a.bmp"), colours)
    photo = read_pages(tmp_path / "a.bmp")
    np.testing.assert_array_equal(photo.pages[0][0], colours)
    assert photo.others == ()


def test_alpha_does_not_darken_colours(tmp_path, image):
    clear = np.dstack([image, np.full(image.shape[:2], 90, np.uint8)])
    Image.fromarray(clear).save(tmp_path / "a.tif")
    np.testing.assert_array_equal(read_photo(tmp_path / "a.tif")[0][..., [2, 1, 0, 3]], clear)


@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
def test_colours_of_print_are_noticed(tmp_path, image, suffix):
    Image.fromarray(image).convert("CMYK").save(tmp_path / f"a{suffix}")
    assert "CMYK" in read_pages(tmp_path / f"a{suffix}").colours
    Image.fromarray(image).save(tmp_path / f"b{suffix}")
    assert not read_pages(tmp_path / f"b{suffix}").colours


def test_avif_of_ten_bits_keeps_them(tmp_path, image):
    deep = image.astype(np.uint16) << 2
    options = [cv2.IMWRITE_AVIF_DEPTH, 10, cv2.IMWRITE_AVIF_QUALITY, 100]
    (tmp_path / "a.avif").write_bytes(cv2.imencode(".avif", deep, options)[1].tobytes())
    found, _ = read_photo(tmp_path / "a.avif")
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found >> 6, deep)
    assert found.max() > 65000  # white is white


@pytest.mark.parametrize("orientation", range(1, 9))
def test_avif_is_not_turned_and_keeps_its_orientation(tmp_path, image, orientation):
    given = Image.Exif()
    given[ExifTags.Base.Orientation] = orientation
    Image.fromarray(image).save(tmp_path / "a.avif", quality=100, subsampling="4:4:4", exif=given)
    found, metadata = read_photo(tmp_path / "a.avif")
    assert np.abs(found[..., ::-1].astype(int) - image).max() <= 6
    write(tmp_path / "b.avif", found, metadata)
    with Image.open(tmp_path / "b.avif") as again:
        assert again.getexif().get(ExifTags.Base.Orientation, 1) == orientation


NAMES = {
    "GIF": "a GIF image",
    "JPEG2000": "a JPEG 2000 image",
    "PDF": "a PDF document",
    "PPM": "a PNM image",
    "ICO": "an icon",
}


@pytest.mark.parametrize("form", NAMES)
def test_what_is_no_photo_is_called_by_its_name(tmp_path, image, form):
    Image.fromarray(image).save(tmp_path / "a.jpg", form)
    for read in (read_photo, read_focal):
        with pytest.raises(ValueError, match=f"it is {NAMES[form]}: convert it to TIFF or PNG first"):
            read(tmp_path / "a.jpg")


def bayer(image):
    """What a sensor behind a mosaic of red, green, green and blue sees, 12 of 16 bits."""
    mosaic = image[..., 1].astype(np.uint16) * 16
    mosaic[::2, ::2], mosaic[1::2, 1::2] = image[::2, ::2, 0] * 16.0, image[1::2, 1::2, 2] * 16.0
    return mosaic


MATRIX = np.array([[1, 1], [0, 1], [0, 1], [0, 1], [1, 1], [0, 1], [0, 1], [0, 1], [1, 1]], np.int32)
TAGS = [
    (271, 2, 0, "Ruler", True),
    (272, 2, 0, "Ruler One", True),
    (50706, 1, 4, (1, 4, 0, 0), True),  # a DNG file
    (50708, 2, 0, "Ruler One", True),
    (33421, 3, 2, (2, 2), True),
    (33422, 1, 4, (0, 1, 1, 2), True),
    (50717, 4, 1, 4095, True),
    (50721, 10, 9, MATRIX.ravel().tolist(), True),
    (50778, 3, 1, 21, True),
    (700, 1, len(XMP), XMP, True),
]


def test_raw_is_developed_with_all_its_bits(tmp_path, image):
    pytest.importorskip("rawpy")
    image = np.repeat(cv2.resize(image, (300, 200)).mean(2, keepdims=True), 3, axis=2).astype(np.uint8)
    tifffile.imwrite(tmp_path / "a.dng", bayer(image), photometric=32803, metadata=None, extratags=TAGS)
    found, metadata = read_photo(tmp_path / "a.dng")
    assert found.dtype == np.uint16
    assert found.shape == (200, 300, 3)
    assert metadata.xmp == XMP
    grey = [cv2.GaussianBlur(each.astype(float).mean(2), (0, 0), 2) for each in (found, image)]
    assert np.corrcoef(grey[0].ravel(), grey[1].ravel())[0, 1] > 0.95
    for name, more, size in (
        ("active", (50829, 4, 4, (10, 20, 190, 280), True), (260, 180)),  # the header says 300 x 200
        ("wide", (50718, 5, 2, (2, 1, 1, 1), True), (600, 200)),
        ("high", (50718, 5, 2, (1, 1, 2, 1), True), (300, 400)),
    ):
        path = tmp_path / f"{name}.dng"
        tifffile.imwrite(path, bayer(image), photometric=32803, metadata=None, extratags=[*TAGS, more])
        assert read_size(path) == read_photo(path)[0].shape[1::-1] == size
    (tmp_path / "b.dng").write_bytes((tmp_path / "a.dng").read_bytes()[:90])
    with pytest.raises(ValueError, match="damaged, or LibRaw does not know this camera"):
        read_photo(tmp_path / "b.dng")


def test_the_mark_leaves_the_packet_as_it_is():
    once = marked(Metadata(xmp=XMP), "undistorted")
    assert geometry_of(once) == "undistorted"
    assert geometry_of(Metadata(xmp=XMP)) is None
    assert once.xmp.startswith(XMP[: XMP.index(b"</rdf:RDF>")])
    assert once.xmp.endswith(b"</rdf:RDF></x:xmpmeta>")
    back = marked(once, "distorted")
    assert geometry_of(back) == "distorted"
    assert len(back.xmp) == len(once.xmp) - 2
    assert geometry_of(marked(Metadata(xmp=b"no packet"), "undistorted")) == "undistorted"


def test_the_mark_tells_the_work():
    once = marked(Metadata(xmp=XMP), "undistorted", "12ab")
    assert work_of(once) == "12ab"
    assert work_of(marked(once, "distorted", "34cd")) == "34cd"
    assert work_of(marked(once, "distorted")) == ""
    assert work_of(Metadata(xmp=XMP)) is None
    assert geometry_of(once) == "undistorted"


def exiftool(path, *options):
    told = subprocess.run(["exiftool", *options, str(path)], check=True, capture_output=True)
    return told.stdout.decode()


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="Needs exiftool.")
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_the_mark_is_found_where_another_program_has_written_the_packet_again(tmp_path, image, suffix):
    framing = (0.5, -1.25, 3.0)
    write(tmp_path / f"a{suffix}", image, marked(Metadata(xmp=XMP), "undistorted", "12ab", framing))
    exiftool(tmp_path / f"a{suffix}", "-q", "-overwrite_original", "-XMP-xmp:Rating=5")
    found = read_metadata(tmp_path / f"a{suffix}")
    assert b"<zoomjax:Geometry>" in found.xmp
    assert (geometry_of(found), work_of(found), framing_of(found)) == ("undistorted", "12ab", framing)
    back = marked(found, "distorted", "34cd")
    assert (geometry_of(back), work_of(back), framing_of(back)) == ("distorted", "34cd", None)
    assert back.xmp.count(b"zoomjax:Geometry") == 1
    assert b"<xmp:Rating>5</xmp:Rating>" in back.xmp
    assert b"a ruler" in back.xmp


def test_what_shares_a_description_with_the_mark_is_kept():
    """Adobe's library, which many programs use, puts all into the attributes of one."""
    shared = packet(
        b'<rdf:Description rdf:about="" xmlns:xmp="http://ns.adobe.com/xap/1.0/"\n xmlns:zoomjax="'
        b'https://zoomjax.invalid/ns/1.0/"\n xmp:Rating="5"\n zoomjax:Version="0.1.0"\n zoomjax:Geometry='
        b"'undistorted'/>"
    )
    assert geometry_of(Metadata(xmp=shared)) == "undistorted"
    back = marked(Metadata(xmp=shared), "distorted")
    assert geometry_of(back) == "distorted"
    assert b'xmp:Rating="5"' in back.xmp
    assert b"a ruler" in back.xmp


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_a_packet_of_another_encoding_or_prefix_is_kept(encoding):
    once = marked(Metadata(xmp=XMP.decode().encode(encoding)), "undistorted")
    assert once == marked(Metadata(xmp=XMP), "undistorted")
    other = marked(
        Metadata(xmp=XMP.replace(b"rdf:", b"r:").replace(b"xmlns:rdf", b"xmlns:r")), "undistorted"
    )
    assert b'dc:source="a ruler"' in other.xmp
    assert geometry_of(other) == "undistorted"
    assert has_no_place(Metadata(xmp=XMP[:-40]))
    assert not has_no_place(Metadata(xmp=XMP))
    assert not has_no_place(Metadata())


def orders(inside):
    return not_corrected_again(Metadata(xmp=packet(inside))).xmp


def test_what_adobe_is_still_to_do_is_not_done_after_a_correction():
    asked = b'<a crs:LensProfileEnable="1" crs:LensManualDistortionAmount="-12" crs:Exposure2012="0.5"/>'
    told = orders(asked)
    assert (
        b'<a crs:LensProfileEnable="0" crs:LensManualDistortionAmount="0" crs:Exposure2012="0.5"/>' in told
    )
    lines = (
        b"<crs:LensProfileEnable>1</crs:LensProfileEnable>\n <crs:LensProfileName>A</crs:LensProfileName>"
    )
    assert lines.replace(b">1<", b">0<") in orders(lines)
    for other in (
        b'<a crs:LensProfileEnable="1" crs:AlreadyApplied="True"/>',
        b'<a crs:LensProfileEnable="0"/>',
        b"",
    ):
        assert orders(other) == packet(other)


@pytest.mark.parametrize("order", "<>")
def test_the_size_in_metadata_is_that_of_the_result(order):
    given = Image.Exif()
    given.endian = order
    given[ExifTags.Base.ImageWidth], given[ExifTags.Base.ImageLength] = 40, 60  # turned
    given[ExifTags.IFD.Exif] = {ExifTags.Base.ExifImageWidth: 60, ExifTags.Base.ExifImageHeight: 40}
    block = given.tobytes().removeprefix(b"Exif\0\0")
    xmp = packet(
        b'<a tiff:ImageWidth="60" tiff:ImageLength="40"/><exif:PixelXDimension>60</exif:PixelXDimension>'
        b"<exif:PixelYDimension>40</exif:PixelYDimension>"
    )
    found = with_size(Metadata(exif=block, xmp=xmp), (60, 40), (70, 44))
    exif = parse_exif(io.BytesIO(found.exif))
    assert (exif[ExifTags.Base.ImageWidth], exif[ExifTags.Base.ImageLength]) == (44, 70)
    own = exif.get_ifd(ExifTags.IFD.Exif)
    assert (own[ExifTags.Base.ExifImageWidth], own[ExifTags.Base.ExifImageHeight]) == (70, 44)
    assert found.xmp == xmp.replace(b"60", b"70").replace(b"40", b"44")
    same = Metadata(exif=block, xmp=xmp)
    assert with_size(same, (61, 40), (70, 44)) == same  # of another image
    assert with_size(same, (60, 40), (60, 40)) == same
    assert exif_with_size(block[:30], (60, 40), (70, 44)) == block[:30]


def like_tiff(begins):
    """A file that is TIFF but for its first four bytes, as those of Olympus and Panasonic."""
    order = "<" if begins.startswith(b"II") else ">"
    return begins + exif(order=order)[4:]


def like_fuji():
    """A JPEG file behind a header of Fujifilm's."""
    image = np.zeros((16, 16, 3), np.uint8)
    content, _ = encoded_photo([(image, Metadata(exif=exif(), xmp=XMP))], ".jpg")
    return b"FUJIFILMCCD-RAW ".ljust(84, b"0") + struct.pack(">2I", 100, len(content)) + bytes(8) + content


def box(name, *content):
    return struct.pack(">I4s", 8 + len(b"".join(content)), name) + b"".join(content)


def like_canon():
    """Boxes, of which some hold a folder of EXIF data each, as a TIFF file, and one XMP."""
    camera, own, place = Image.Exif(), Image.Exif(), Image.Exif()
    camera[ExifTags.Base.Make], camera[ExifTags.Base.Orientation] = "Canon", 6
    own[ExifTags.Base.FocalLength], own[ExifTags.Base.LensModel] = 35.0, "RF24-105mm F4 L IS USM"
    place[ExifTags.GPS.GPSLatitudeRef] = "N"
    parts = [
        box(name, folder.tobytes().removeprefix(b"Exif\0\0"))
        for name, folder in ((b"CMT1", camera), (b"CMT2", own), (b"CMT3", Image.Exif()), (b"CMT4", place))
    ]
    own_box = box(b"uuid", bytes.fromhex("85c0b687820f11e08111f4ce462b6a48"), box(b"CNCV", b"0"), *parts)
    xmp = box(b"uuid", bytes.fromhex("be7acfcb97a942e89c71999491e3afac"), XMP)
    return box(b"ftyp", b"crx \0\0\0\1crx isom") + box(b"moov", own_box, box(b"mvhd", bytes(40))) + xmp


def like_minolta():
    blocks = [(b"\0PRD", bytes(24)), (b"\0TTW", exif(order=">")), (b"\0WBG", bytes(12))]
    every = b"".join(struct.pack(">4sI", name, len(of)) + of for name, of in blocks)
    return struct.pack(">4sI", b"\0MRM", len(every)) + every


def test_exif_data_in_boxes_are_put_together():
    """Of Canon's newer files the lens, the orientation and the place were lost, and XMP."""
    found = raw_metadata(like_canon())
    exif = parse_exif(io.BytesIO(found.exif))
    assert (exif[ExifTags.Base.Make], exif[ExifTags.Base.Orientation]) == ("Canon", 6)
    assert exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] == "N"
    assert exif_equipment(found.exif).lens == "RF24-105mm F4 L IS USM"
    assert found.xmp == XMP


@pytest.mark.parametrize(
    "content",
    [
        *map(like_tiff, (b"IIRO", b"IIRS", b"IIU\0", b"MMOR", b"II*\0")),
        *(like_fuji(), like_canon(), like_minolta()),
    ],
)
def test_exif_data_of_raw_files_are_found(tmp_path, content):
    (tmp_path / "a.orf").write_bytes(content)
    assert read_focal(tmp_path / "a.orf") == 35
    for end in range(0, min(len(content), 600), 7):
        raw_metadata(content[:end])  # damaged: nothing is raised


def test_what_is_not_read_of_a_raw_file_is_named(tmp_path, image):
    pytest.importorskip("rawpy")
    raw = tmp_path / "a.dng"
    tifffile.imwrite(raw, bayer(np.repeat(image, 5, 0)), photometric=32803, metadata=None, extratags=TAGS)
    assert read_pages(raw).others == ()
    content = raw.read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zoomjax.io.raw.raw_metadata", lambda content: Metadata())
        assert read_pages(raw).others == ("EXIF data and XMP, which are not read of such files",)
    assert raw.read_bytes() == content


def test_a_raw_photo_that_is_developed_to_srgb_says_so():
    given = Image.Exif()
    given[ExifTags.IFD.Exif] = {
        ExifTags.Base.ColorSpace: 65535,
        ExifTags.Base.FocalLength: 35.0,
        ExifTags.IFD.Interop: {1: "R03"},
    }
    block = given.tobytes().removeprefix(b"Exif\0\0")
    own = parse_exif(io.BytesIO(exif_in_srgb(block))).get_ifd(ExifTags.IFD.Exif)
    assert own == {ExifTags.Base.ColorSpace: 1, ExifTags.Base.FocalLength: 35.0}
    assert exif_in_srgb(exif()) == exif()


TEXTS = {
    "-IFD0:Artist": "J\u00f6rg M\u00fcller",
    "-ExifIFD:OwnerName": "\u0160\u00e1rka",
    "-ExifIFD:LensModel": "18\u2013200 mm",
    "-GPS:GPSMapDatum": "B\u00e4rn",
    "-IFD0:XPTitle": "\u00fcber",
    "-IFD0:DocumentName": "Stra\u00dfe",
    "-IFD0:Rating": "4",
    "-InteropIFD:InteropIndex": "R98",
}


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="Needs exiftool.")
@pytest.mark.parametrize("suffix", [".tif", ".avif", ".png", ".webp"])
def test_texts_of_any_alphabet_are_kept(tmp_path, image, suffix):
    write(tmp_path / "a.jpg", image, Metadata(exif=exif()))
    given = [f"{tag}#={text}" for tag, text in TEXTS.items()]
    exiftool(tmp_path / "a.jpg", "-q", "-overwrite_original", *given)
    asked = ["-G1", "-s", "-n", *TEXTS]
    expected = exiftool(tmp_path / "a.jpg", *asked)
    assert len(expected.splitlines()) == len(TEXTS)
    write(tmp_path / f"b{suffix}", image, read_metadata(tmp_path / "a.jpg"))
    assert exiftool(tmp_path / f"b{suffix}", *asked) == expected
    write(tmp_path / "c.tif", image, read_metadata(tmp_path / f"b{suffix}"))
    assert exiftool(tmp_path / "c.tif", *asked) == expected


def test_an_orientation_that_is_added_leaves_texts_as_they_are():
    given = Image.Exif()
    given[ExifTags.Base.Artist] = "J\u00f6rg".encode()
    block = given.tobytes().removeprefix(b"Exif\0\0")
    assert "J\u00f6rg".encode() in exif_with_orientation(block, 6)


@pytest.mark.parametrize("orientation", [None, 1, 6])
def test_exif_data_of_avif_files_are_those_that_were_given(tmp_path, image, orientation):
    block = exif() if orientation is None else exif_with_orientation(exif(), orientation)
    block += b"a thumbnail"
    write(tmp_path / "a.avif", image, Metadata(exif=block))
    found, metadata = read_photo(tmp_path / "a.avif")
    assert metadata.exif == block
    assert found.shape == image.shape


def test_notes_of_the_maker_are_left_out_of_tiff_files_and_named(tmp_path, image):
    given = Image.Exif()
    given[ExifTags.IFD.Exif] = {
        ExifTags.Base.MakerNote: b"notes of a maker",
        ExifTags.Base.FocalLength: 35.0,
    }
    block = given.tobytes().removeprefix(b"Exif\0\0")
    assert write(tmp_path / "a.jpg", image, Metadata(exif=block)) == []
    assert read_metadata(tmp_path / "a.jpg").exif == block
    assert write(tmp_path / "a.tif", image, Metadata(exif=block)) == ["the camera maker's notes"]
    folders = ImageFileDirectory_v2()
    folders[ExifTags.IFD.Exif] = {ExifTags.Base.MakerNote: b"notes of a maker"}
    Image.fromarray(image).save(tmp_path / "b.tif", tiffinfo=folders)
    with tifffile.TiffFile(tmp_path / "b.tif") as file:
        assert "MakerNote" in file.pages[0].tags["ExifTag"].value
    assert "the camera maker's notes" in read_pages(tmp_path / "b.tif").others


@pytest.mark.parametrize("kind", [1, 4, 7])
def test_iptc_data_of_any_type_are_kept_without_a_word(tmp_path, image, kind):
    """Adobe's programs and exiftool call the bytes whole numbers of 32 bits (4)."""
    block = IIM + bytes(-len(IIM) % 4)
    values = struct.unpack(f"<{len(block) // 4}I", block) if kind == 4 else block
    path = tmp_path / "a.tif"
    tags = [(33723, kind, len(values), values, True), (ExifTags.Base.Make, 2, 0, "Nikon", True)]
    tifffile.imwrite(path, image, extratags=tags, metadata=None)
    assert read_equipment(path).maker == "Nikon"
    [(_, found)] = read_pages(path).pages
    assert IIM in found.iptc
    assert read_metadata(path).iptc == found.iptc
    write(tmp_path / "b.jpg", image, found)
    with Image.open(tmp_path / "b.jpg") as opened:
        assert IptcImagePlugin.getiptcinfo(opened)[2, 120] == b"ruler"


def packet(inside):
    return XMP.replace(b"</rdf:RDF>", inside + b"</rdf:RDF>")


APPLIED = b'crs:AlreadyApplied="True"'
HISTORY = b'<rdf:li darktable:num="8" darktable:operation="lens" darktable:enabled="%d"/>'
DIGIKAM = b"<digiKam:LensCorrectionSettings>Distortion Correction: %s ;</digiKam:LensCorrectionSettings>"


@pytest.mark.parametrize(
    ("inside", "program"),
    [
        (b'<rdf:Description crs:LensProfileEnable="1" ' + APPLIED + b"/>", "Adobe's lens correction"),
        (b"<a " + APPLIED + b' crs:LensManualDistortionAmount="+12"/>', "Adobe's lens correction"),
        (
            b"<crs:AlreadyApplied>True</crs:AlreadyApplied><crs:LensProfileEnable>1</crs:LensProfileEnable>",
            "Adobe's lens correction",
        ),
        (b'<rdf:Description crs:LensProfileEnable="0" ' + APPLIED + b"/>", None),
        (b'<a crs:LensProfileEnable="1" crs:AlreadyApplied="False"/>', None),  # settings of a RAW photo
        (b'<a crs:LensProfileEnable="1"/>', None),
        (
            b'<a crs:LensManualDistortionAmount="0" ' + APPLIED + b"/>",
            None,
        ),
        (HISTORY % 1, "darktable"),
        (HISTORY % 0, None),
        (b'<rdf:li darktable:enabled="1" darktable:operation="exposure"/>' + HISTORY % 0, None),
        (DIGIKAM % b"enabled", "digiKam"),
        (DIGIKAM % b"disabled", None),
        (b"", None),
    ],
)
def test_photos_that_say_that_their_distortion_was_corrected(tmp_path, image, inside, program):
    for suffix in (".jpg", ".png", ".tif", ".webp"):
        write(tmp_path / f"a{suffix}", image, Metadata(xmp=packet(inside)))
        assert straightened_by(read_metadata(tmp_path / f"a{suffix}")) == program
    assert straightened_by(marked(Metadata(xmp=packet(inside)), "undistorted")) == "zoomjax"


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="Needs exiftool.")
def test_what_exiftool_writes_of_corrections_is_read(tmp_path, image):
    write(tmp_path / "a.jpg", image, Metadata())
    tags = ["-XMP-crs:AlreadyApplied=True", "-XMP-crs:LensProfileEnable=1", "-overwrite_original"]
    subprocess.run(["exiftool", "-q", *tags, str(tmp_path / "a.jpg")], check=True)
    assert straightened_by(read_metadata(tmp_path / "a.jpg")) == "Adobe's lens correction"


def test_pixels_that_are_not_square(tmp_path, image):
    written, _ = encoded_photo([(image, Metadata())], ".jpg")
    at = written.index(b"JFIF\0") + 7
    (tmp_path / "a.jpg").write_bytes(written[:at] + struct.pack(">BHH", 0, 59, 54) + written[at + 5 :])
    found = read_metadata(tmp_path / "a.jpg")
    assert (found.dpi, found.shape, squeezed(found)) == (None, (59, 54), (59, 54))
    assert write(tmp_path / "b.jpg", image, found) == []
    assert write(tmp_path / "b.png", image, found) == []
    assert read_metadata(tmp_path / "b.jpg").shape == read_metadata(tmp_path / "b.png").shape == (59, 54)
    assert write(tmp_path / "b.tif", image, found) == ["the shape of the pixels"]
    Image.fromarray(image).save(tmp_path / "c.png", dpi=(300, 200))
    assert squeezed(read_metadata(tmp_path / "c.png")) == pytest.approx((300, 200), abs=0.02)
    for name in ("d.jpg", "d.png", "d.tif"):
        Image.fromarray(image).save(tmp_path / name, dpi=(300, 300))
        assert squeezed(read_metadata(tmp_path / name)) is None
