"""Where what can be made again is kept."""

import os
from pathlib import Path

import pytest

from zoomjax._core.files import cache_folder


def test_a_named_folder_comes_first(monkeypatch, tmp_path):
    monkeypatch.setenv("ZOOMJAX_CACHE", str(tmp_path))
    assert cache_folder("detections") == tmp_path / "detections"


@pytest.mark.parametrize("base", [None, "elsewhere"])
def test_else_it_is_the_users_cache(monkeypatch, tmp_path, base):
    monkeypatch.delenv("ZOOMJAX_CACHE")
    for variable in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(variable, raising=False)
        if base:
            monkeypatch.setenv(variable, str(tmp_path / base))
    expected = tmp_path / base if base else Path.home() / ".cache"
    assert cache_folder("compiled") == expected / "zoomjax" / "compiled"


@pytest.mark.parametrize("base", [None, "", "relative"])
def test_without_a_home_there_is_none(base, monkeypatch):
    """Neither in the working folder nor where others could fill it."""
    for variable in ("ZOOMJAX_CACHE", "HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(variable, raising=False)
        if base is not None and variable == "XDG_CACHE_HOME":
            monkeypatch.setenv(variable, base)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as where the system knows none
    assert cache_folder("compiled") is None
