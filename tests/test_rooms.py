"""The picture of the rooms in docs/architecture.md: that of the imports which the tests of layers find."""

import re
import xml.etree.ElementTree as ET

import pytest

from docs.make import rooms

from .test_layers import FILES, ROOMS, own, room

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def picture():
    return ET.fromstring(rooms.PICTURE.read_text())


def imported():
    arrows = {name: set() for name in ROOMS}
    for name in FILES:
        if room(name) in arrows:
            arrows[room(name)] |= {room(other) for other in own(name)} - {room(name)}
    return arrows


def reached(arrows, start):
    return {start}.union(*(reached(arrows, other) for other in arrows[start]))


def test_the_picture_is_that_of_the_code():
    assert rooms.PICTURE.read_text() == rooms.svg(rooms.imports())


def test_imports_are_those_that_the_layers_see():
    assert rooms.imports() == imported()


def test_the_picture_has_every_room_and_its_arrows_lead_to_all_that_it_imports(picture):
    assert {g.get("data-room") for g in picture.iter(f"{SVG}g")} == set(ROOMS)
    drawn = {name: set() for name in ROOMS}
    for path in picture.iter(f"{SVG}path"):
        if path.get("data-arrow"):
            start, end = path.get("data-arrow").split()
            drawn[start].add(end)
    for name, others in imported().items():
        assert drawn[name] <= others
        assert others <= reached(drawn, name)


def test_boxes_do_not_overlap_and_arrows_go_down(picture):
    boxes = [
        {key: int(r.get(key)) for key in ("x", "y", "width", "height")} for r in picture.iter(f"{SVG}rect")
    ]
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            apart = a["x"] + a["width"] <= b["x"] or b["x"] + b["width"] <= a["x"]
            assert apart or a["y"] + a["height"] <= b["y"] or b["y"] + b["height"] <= a["y"]
    for path in picture.iter(f"{SVG}path"):
        if path.get("data-arrow"):
            start, *_, end = map(int, re.findall(r"(?:M\d+ |V)(\d+)", path.get("d")))
            assert start < end


def test_a_room_that_has_no_place_yet_is_drawn_beside_the_others():
    arrows = {"app": {"new", "other"}, "new": {"_core"}, "other": {"_core"}, "_core": set()}
    places = rooms.places(arrows)
    assert places["new"].top == places["other"].top
    assert places["new"].right <= places["other"].left
