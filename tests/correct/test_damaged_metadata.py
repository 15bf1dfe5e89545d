"""Photos with damaged metadata are corrected like others: pixels, pages and what is sound are kept."""

import warnings
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import ImageCms

import zoomjax as zj
from benchmarks.mutations import damaged
from zoomjax.io.exif import exif_focal
from zoomjax.io.metadata import Metadata, geometry_of, marked
from zoomjax.io.photo import read_pages
from zoomjax.io.photo_writer import encoded_photo

from .._exif import exif

NUMBER = 50
SUFFIXES = (".jpg", ".png", ".webp", ".tif", ".avif")
SIZE = (48, 32)
XMP = b"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:xmp="http://ns.adobe.com/xap/1.0/" xmp:Rating="3"
 xmlns:crs="http://ns.adobe.com/camera-raw-settings/1.0/" crs:LensProfileEnable="1">
<xmp:CreatorTool>A &amp; B</xmp:CreatorTool></rdf:Description></rdf:RDF></x:xmpmeta>"""
WHOLE = {
    "exif": exif(),
    "xmp": XMP,
    "icc": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
    "iptc": b"8BIM\x04\x04\0\0\0\0\0\x0c\x1c\x02\x50\0\x04J\xf6rg\0\0\0",
    "comment": b"J\xf6rg",
}


def lens():
    zoom = zj.PolynomialZoom(1, jnp.array([[-0.17, 0.02], [0.43, -0.02]]), jnp.array(20.0))
    return zj.ZoomLens(zoom, (jnp.array(SIZE) - 1) / 2, jnp.array([20.0, 80.0]), SIZE)


def some(rng):
    """Metadata with damaged and without some fields; of a photo that was corrected before, sometimes."""
    whole = (
        WHOLE if rng.random() < 0.7 else WHOLE | {"xmp": marked(Metadata(xmp=XMP), "undistorted", "0").xmp}
    )
    fields = {}
    for name, content in whole.items():
        match rng.integers(6):
            case 0:
                continue
            case 1 | 2:
                fields[name] = content
            case _:
                fields[name] = damaged(content, rng, whole["xmp"])
    return Metadata(**fields)


def photos(suffix):
    """Files with such metadata; a third of them damaged themselves."""
    rng = np.random.default_rng(len(suffix) + SUFFIXES.index(suffix))
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    image = np.stack([5 * columns, 7 * rows, 3 * columns + 2 * rows], axis=-1).astype(np.uint8)
    for _ in range(NUMBER):
        pages = ((image, some(rng)),) * (int(rng.integers(1, 3)) if suffix == ".tif" else 1)
        content, _ = encoded_photo(pages, suffix)
        yield damaged(content, rng) if rng.random() < 0.3 else content


def is_sound(xmp):
    try:
        ElementTree.fromstring(xmp.strip(b"\0 \n").decode())
    except (ElementTree.ParseError, ValueError):
        return False
    return True


def refused(source, target):
    """The error of a photo that is not corrected; empty if it is."""
    try:
        zj.undistort_photo(source, target, lens=lens(), focal=35.0, again=True)
    except (ValueError, OSError) as error:
        return str(error)
    return ""


@pytest.mark.parametrize("block", [b"no EXIF data", b"II*\0", b"xx" + exif(), exif()[:30]])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_exif_data_are_kept_or_said_to_be_lost(suffix, block, tmp_path):
    image = np.full((*SIZE[::-1], 3), 99, np.uint8)
    (tmp_path / "in.jpg").write_bytes(encoded_photo([(image, Metadata(exif=block))], ".jpg")[0])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        zj.undistort_photo(tmp_path / "in.jpg", tmp_path / f"out{suffix}", lens=lens(), focal=35.0)
    [(_, metadata)] = read_pages(tmp_path / f"out{suffix}").pages
    said = [str(each.message).partition("file: ")[2] for each in told]
    if suffix in (".jpg", ".png", ".webp") or (block[:2] == b"II" and len(block) > 8):
        assert metadata.exif.startswith(block[:20] if suffix != ".tif" else b"II*\0")
        assert said == []
    else:
        assert said == ["EXIF data, which are damaged."]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_sound_is_kept_and_what_is_lost_is_said(suffix, tmp_path):
    source, target, read = tmp_path / f"in{suffix}", tmp_path / f"out{suffix}", 0
    for content in photos(suffix):
        source.write_bytes(content)
        target.unlink(missing_ok=True)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            error = refused(source, target)
        if error:
            assert str(source) in error
            assert not target.exists()
            continue
        said = "\n".join(str(each.message) for each in told)
        assert said.count("\n") < 4, said
        assert all(str(source) in str(each.message) for each in told), said
        before, after = (read_pages(path).pages for path in (source, target))
        assert len(after) == len(before)
        for (image, had), (corrected, has) in zip(before, after, strict=True):
            expected = zj.undistort_image(image, lens(), focal=35.0)
            if suffix in (".png", ".tif"):
                np.testing.assert_array_equal(corrected, expected)
            assert corrected.shape == expected.shape
            assert geometry_of(has) == "undistorted"
            assert is_sound(has.xmp) or not is_sound(had.xmp)
            assert has.icc == had.icc or "the colour profile" in said
            assert exif_focal(has.exif) == exif_focal(had.exif) or "EXIF" in said
            assert has.exif or not had.exif or "EXIF" in said
            assert has.iptc == had.iptc or "IPTC" in said
            assert has.comment == had.comment or b"\0" in had.comment or "the comment" in said
        read += 1
    assert read > NUMBER // 3
