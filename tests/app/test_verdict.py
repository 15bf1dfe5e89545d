"""What photos say against one lens having taken them."""

from PIL import ExifTags, Image

from zoomjax.app.verdict import findings_of_photos


def photo(path, model=None, lens=None):
    exif = Image.Exif()
    if model is not None:
        exif[ExifTags.Base.Model] = model
    if lens is not None:
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.LensModel: lens}
    Image.new("L", (40, 40)).save(path, exif=exif)
    return path


def test_photos_of_one_lens_say_nothing(tmp_path):
    photos = [photo(tmp_path / f"{n}.jpg", "D90", "18-200") for n in range(3)]
    photos.append(photo(tmp_path / "unknown.jpg"))
    assert findings_of_photos(photos) == []


def test_two_lenses_and_bodies_are_doubtful(tmp_path):
    photos = [photo(tmp_path / f"{n}.jpg", f"D{n // 3}", f"lens {n % 2}") for n in range(5)]
    lenses, cameras = findings_of_photos(photos)
    assert (lenses.verdict, cameras.verdict) == ("doubtful", "doubtful")
    assert lenses.found == (
        "the photos were taken with 2 different lenses, by their EXIF data: lens 0 (3 photos), lens 1 "
        "(2 photos)."
    )
    assert "D0 (3 photos), D1 (2 photos)" in cameras.found
