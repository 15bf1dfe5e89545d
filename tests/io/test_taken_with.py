"""Names of camera and lens in EXIF data written by Pillow."""

from PIL import ExifTags, Image

from zoomjax.io.taken_with import TakenWith, read_taken_with


def photo(path, model=None, lens=None):
    exif = Image.Exif()
    if model is not None:
        exif[ExifTags.Base.Model] = model
    if lens is not None:
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.LensModel: lens}
    Image.new("L", (40, 40)).save(path, exif=exif)
    return path


def test_names_are_read_without_what_fills_their_fields(tmp_path):
    found = read_taken_with(photo(tmp_path / "a.jpg", "NIKON  D90 ", "18.0-200.0 mm"))
    assert found == ("NIKON D90", "18.0-200.0 mm")
    assert read_taken_with(photo(tmp_path / "b.png", "X", "----")) == ("X", "")


def test_photos_that_tell_nothing_have_no_names(tmp_path):
    assert read_taken_with(photo(tmp_path / "c.jpg")) == TakenWith()
    assert read_taken_with(tmp_path / "none.jpg") == TakenWith()
    (tmp_path / "d.jpg").write_bytes(b"no photo")
    assert read_taken_with(tmp_path / "d.jpg") == TakenWith()
