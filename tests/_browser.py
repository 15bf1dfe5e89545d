"""Pages opened in a headless Chromium, if there is one."""

import shutil
import subprocess
from pathlib import Path

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def opened(page: Path, profile: Path, *, arguments: str = "") -> tuple[str, list[str]]:
    """The document after its scripts have run, and what they wrote on the console."""
    if CHROMIUM is None:
        pytest.skip("Needs a browser: chromium, chromium-browser or google-chrome.")
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]
    command += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    command += [
        "--allow-file-access-from-files",
        "--hide-scrollbars",
        "--window-size=1300,900",
        "--virtual-time-budget=10000",
    ]
    command += [f"--user-data-dir={profile}", "--enable-logging=stderr", "--dump-dom"]
    done = subprocess.run(
        [*command, page.as_uri() + arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]
