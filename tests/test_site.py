"""The documentation site: complete, by itself, and in a browser without errors, opened from its folder."""

import json
import re
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

from ._browser import opened
from ._public import DOORS

pytest.importorskip("zensical", reason="Needs the extra docs.")
pytest.importorskip("nbconvert", reason="Needs the extra docs.")

from docs.make import site

pytestmark = pytest.mark.slow


class Page(HTMLParser):
    """What a page loads, where its links lead, and the places that links can lead to."""

    def __init__(self, path):
        super().__init__()
        self.loaded, self.links, self.places = [], [], {""}
        self.feed(path.read_text())

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.places |= {found.get("id"), found.get("name")}
        if tag in ("script", "img", "iframe", "link", "source"):
            self.loaded += [found.get("src") or found.get("href")] if {"src", "href"} & set(found) else []
        elif tag == "a" and found.get("href"):
            self.links.append(found["href"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return site.build(tmp_path_factory.mktemp("site") / "out").parent


@pytest.fixture(scope="module")
def pages(folder):
    paths = [path for path in folder.rglob("*.html") if path.name != "404.html"]
    return {path.resolve(): Page(path) for path in paths}


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(pages, folder):
    for path, page in pages.items():
        for address in page.loaded:
            assert not urlparse(address).netloc, f"{path}: {address}"
            if not address.startswith("data:"):
                assert (path.parent / unquote(address.partition("?")[0])).exists(), f"{path}: {address}"
    styles = "".join(path.read_text() for path in folder.rglob("*.css"))
    assert not re.search(r"url\(['\"]?(https?:)?//|@import", styles)


def test_all_links_lead_somewhere(pages):
    for path, page in pages.items():
        for address in page.links:
            parts = urlparse(address)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            assert target.exists(), f"{path}: {address}"
            if parts.fragment and target in pages:
                assert unquote(parts.fragment) in pages[target].places, f"{path}: {address}"


def test_every_room_has_a_page():
    assert set(site.ROOMS) == set(DOORS)


@pytest.mark.slow
@pytest.mark.parametrize("room", site.ROOMS)
def test_every_public_name_has_its_entry(pages, folder, room):
    places = pages[(folder / "api" / f"{room}.html").resolve()].places
    assert {f"zoomjax.{room}.{name}" for name in DOORS[room].__all__} <= places


def test_api_tells_shapes_units_and_errors(folder):
    text = re.sub(r"<[^>]+>", "", (folder / "api" / "lines.html").read_text())
    assert "Float[" in text
    assert "px" in text
    assert "ValueError" in text


def test_names_that_share_a_line_of_a_docstring_have_one_each(folder):
    text = (folder / "api" / "trust.html").read_text()
    entry = text[text.index('id="zoomjax.trust.Suggestion"') :]
    entry = re.sub(r"<[^>]+>", "", re.split(r'id="zoomjax\.trust\.(?!Suggestion)', entry)[0])
    assert re.search(r"\bbefore\s+\(float", " ".join(entry.split()))
    assert re.search(r"\bafter\s+\(float", " ".join(entry.split()))


def test_every_page_is_in_the_navigation(tmp_path):
    site.gather(tmp_path)
    nav = tomllib.loads((tmp_path / "zensical.toml").read_text())["project"]["nav"]
    listed = set(re.findall(r"'([^']+\.md)'", str(nav)))
    there = {str(path.relative_to(tmp_path / "pages")) for path in (tmp_path / "pages").rglob("*.md")}
    assert listed == there


@pytest.mark.parametrize("name", ["index", "notebooks/03-the-papers-experiment", "api/fit"])
def test_a_page_opens_without_errors(folder, tmp_path, name):
    document, console = opened(folder / f"{name}.html", tmp_path / "profile")
    assert not console
    assert re.search(r'<html[^>]* class="[^"]*\bjs\b', document)


def test_pictures_of_a_tutorial_are_there(pages, folder):
    page = pages[(folder / "notebooks" / "03-the-papers-experiment.html").resolve()]
    assert sum(address.endswith(".png") and "_files/" in address for address in page.loaded) >= 3


PROBE = """<!DOCTYPE html><meta charset="utf-8">
<iframe id="page" src="index.html" style="width:1200px;height:800px"></iframe><pre id="found"></pre>
<script>
onload = () => {
  const page = document.getElementById("page"), inside = page.contentDocument;
  inside.querySelector("button.md-search__button").click();
  setTimeout(() => {
    const box = [...inside.querySelectorAll("*")].find((one) => one.shadowRoot).shadowRoot;
    const input = box.querySelector("input");
    input.value = "certificate";
    input.dispatchEvent(new page.contentWindow.InputEvent("input", { bubbles: true }));
    setTimeout(() => {
      const found = [...box.querySelectorAll("a")].map((one) => one.getAttribute("href"));
      document.getElementById("found").textContent = JSON.stringify(found);
    }, 3000);
  }, 2000);
};
</script>"""


def test_search_works_without_a_server(folder, tmp_path):
    probe = folder / "probe.html"
    probe.write_text(PROBE)
    document, console = opened(probe, tmp_path / "profile")
    probe.unlink()
    assert not console
    found = json.loads(re.search(r'<pre id="found">(.*?)</pre>', document)[1])
    assert any("api/models.html" in address and "Certificate" in address for address in found)


def test_a_link_that_leads_nowhere_stops_the_build(tmp_path, monkeypatch):
    whole = site.gather

    def broken(work):
        whole(work)
        with (work / "pages" / "index.md").open("a") as page:
            page.write("\n[nowhere](docs/nowhere.md)\n")

    monkeypatch.setattr(site, "gather", broken)
    with pytest.raises(SystemExit, match=r"nowhere\.md"):
        site.build(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_no_site_is_not_replaced(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(SystemExit, match="choose another folder"):
        site.build(tmp_path)
    assert (tmp_path / "precious.txt").exists()


def test_the_search_index_has_all_pages(folder):
    items = json.loads((folder / "search.json").read_text())["items"]
    located = {Path(item["location"].partition("#")[0]).name for item in items}
    assert {"index.html", "trust.html", "fit.html", "04-your-own-lens.html"} <= located
