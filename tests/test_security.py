"""What the package never does: no pickle, no network, no shell, no code from data."""

import ast
from pathlib import Path

import pytest

import zoomjax

ROOT = Path(zoomjax.__file__).parent
FILES = {
    path.relative_to(ROOT).as_posix(): path for path in sorted(ROOT.rglob("*.py*")) if path.suffix != ".pyc"
}

MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "ctypes", "code"}
MODULES |= {
    "socket",
    "ssl",
    "ftplib",
    "smtplib",
    "telnetlib",
    "http",
    "urllib",
    "requests",
    "httpx",
    "aiohttp",
}
MODULES |= {"subprocess", "pty", "webbrowser", "xmlrpc", "socketserver", "imaplib", "poplib", "runpy"}
HARMLESS = {"urllib.parse"}
ALLOWED = {"app/cluster.py": ["imports socket"], "_core/memory.py": ["imports ctypes"]}
"""A cluster is reached where the command line is given its address, and nothing else is.

One function of the C library is called, without data: `malloc_trim`.
"""
CALLS = {"eval", "exec", "compile", "__import__"}
METHODS = {
    "os": {"system", "popen", "fork", "forkpty", "startfile"},
    "tempfile": {"mktemp"},
    "jnp": {"load"},
}
PREFIXES = {"os": ("exec", "spawn", "posix_spawn")}


def offences(text):
    """What a source does that it must not."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            relative = isinstance(node, ast.ImportFrom) and node.level
            names = (
                [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            )
            for name in [] if relative else names:
                if name.split(".")[0] in MODULES and name not in HARMLESS:
                    yield f"line {node.lineno}: imports {name}"
        elif isinstance(node, ast.Call):
            yield from _of_call(node)


def _of_call(node):
    function = node.func
    if isinstance(function, ast.Name) and function.id in CALLS:
        yield f"line {node.lineno}: calls {function.id}"
    for keyword in node.keywords:
        if keyword.arg in ("shell", "allow_pickle") and getattr(keyword.value, "value", True) is not False:
            yield f"line {node.lineno}: {keyword.arg}"
    if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name):
        module, name = function.value.id, function.attr
        if name in METHODS.get(module, ()) or name.startswith(PREFIXES.get(module, ("\0",))):
            yield f"line {node.lineno}: calls {module}.{name}"
        if (module, name) == ("np", "load") and "allow_pickle" not in {k.arg for k in node.keywords}:
            yield f"line {node.lineno}: np.load without allow_pickle=False"


@pytest.mark.parametrize("name", FILES)
def test_no_pickle_no_network_no_shell(name):
    found = [offence.partition(": ")[2] for offence in offences(FILES[name].read_text(encoding="utf-8"))]
    assert found == ALLOWED.get(name, [])


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from socket import create_connection",
        "import urllib.request",
        "from urllib import request",
        "def f():\n    import subprocess",
        "eval('1')",
        "os.system('ls')",
        "os.execv('a', [])",
        "np.load(file)",
        "np.load(file, allow_pickle=True)",
        "np.load(file, allow_pickle=wanted)",
        "np.savez(file, allow_pickle=True)",
        "run(command, shell=True)",
        "tempfile.mktemp()",
    ],
)
def test_each_would_be_found(text):
    assert list(offences(text))


@pytest.mark.parametrize(
    "text", ["from urllib.parse import quote", "np.load(f, allow_pickle=False)", "model.eval()"]
)
def test_what_is_harmless_is_not(text):
    assert not list(offences(text))
