"""HTML from text, escaped, and the style of the report."""

from collections.abc import Iterable, Sequence
from html import escape

from .._core.text import plain


class Html(str):
    """Text that is HTML already."""


Content = str | Iterable[str]


def _text(content: Content) -> Html:
    """Escaped, unless it is HTML; of several parts, each."""
    if isinstance(content, Html):
        return content
    return Html(escape(_shown(content)) if isinstance(content, str) else "".join(map(_text, content)))


def _shown(text: str) -> str:
    """Without orders to whoever reads it; warnings have lines."""
    return "\n".join(map(plain, text.split("\n")))


def joined(parts: Sequence[str]) -> Html:
    return Html(", ".join(map(_text, parts)))


def element(name: str, content: Content, **attributes: str) -> Html:
    """``<name ...>content</name>``; attributes are written as in Python: ``class_``, ``aria_label``."""
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value)}"' for key, value in attributes.items()
    )
    return Html(f"<{name}{given}>{_text(content)}</{name}>")


def section(key: str, title: str, content: Content) -> Html:
    return element("section", [element("h2", title), _text(content)], id=key)


def box(label: str, content: Content, class_: str = "box") -> Html:
    """What may be wider than a phone: it scrolls by itself, also by keyboard."""
    return element("div", content, class_=class_, role="region", aria_label=label, tabindex="0")


def table(label: str, head: Sequence[str], rows: Iterable[Sequence[Content]]) -> Html:
    """A table whose first column names the rows."""
    lines = [
        element("tr", [element("th", row[0], scope="row"), *(element("td", cell) for cell in row[1:])])
        for row in rows
    ]
    names = element("tr", [element("th", name, scope="col") for name in head])
    return box(label, element("table", [element("thead", names), element("tbody", lines)]), "box fit")


STYLE = """
:root { color-scheme: light dark; --page: #f6f5f2; --card: #fff; --ink: #1c1917; --soft: #6b645c;
  --rule: #e3dfd8; --model: #c2410c; --warn: #fff4e5; --link: #1e3a5f; }
@media (prefers-color-scheme: dark) {
  :root { --page: #0f0f0f; --card: #1a1a1a; --ink: #ececea; --soft: #a8a29a; --rule: #35322e;
    --model: #fb8a4c; --warn: #33240f; --link: #9cc3ee; }
  .plot img { filter: invert(0.898) hue-rotate(180deg); } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 66rem; margin: auto; padding: clamp(1rem, 4vw, 2.5rem); overflow-wrap: anywhere; }
h1 { font-size: clamp(1.6rem, 5vw, 2.3rem); line-height: 1.15; letter-spacing: -0.02em; margin: 0; }
h2 { font-size: 1.25rem; margin: 0 0 0.5rem; }
p { margin: 0 0 0.8rem; max-width: 46rem; }
header p, footer { color: var(--soft); }
header p { margin: 0.5rem 0 1.5rem; }
section { margin-top: 2.5rem; }
footer { margin-top: 3rem; padding-top: 1rem; border-top: 1px solid var(--rule); font-size: 0.9rem; }
a { color: var(--link); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: 0.75rem;
  margin: 0; }
.cards div { display: flex; flex-direction: column-reverse; justify-content: flex-end;
  background: var(--card);
  border: 1px solid var(--rule); border-radius: 0.6rem; padding: 0.9rem 1rem; }
dd { margin: 0; font-size: 1.45rem; font-weight: 650; letter-spacing: -0.01em; line-height: 1.25;
  font-variant-numeric: tabular-nums; }
dt { color: var(--soft); font-size: 0.85rem; line-height: 1.35; margin-top: 0.2rem; }
aside { background: var(--warn); border-left: 4px solid var(--model); border-radius: 0.3rem;
  padding: 0.8rem 1rem; margin-top: 1rem; white-space: pre-line; }
.box { overflow-x: auto; background: var(--card); border: 1px solid var(--rule); border-radius: 0.6rem;
  margin: 0 0 1rem; }
.fit { width: fit-content; max-width: 100%; }
.formulas { padding: 0.8rem 1rem 0; }
.formulas p { max-width: none; font-variant-numeric: tabular-nums; }
.term { white-space: nowrap; }
figure { margin: 0 0 1rem; }
.plot { padding: 0.75rem; }
.plot img { display: block; max-width: 100%; height: auto; margin: auto; }
.wide img { min-width: 36rem; }
table { border-collapse: collapse; width: 100%; font-size: 0.92rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.45rem 0.9rem; text-align: right; vertical-align: top; white-space: nowrap;
  border-top: 1px solid var(--rule); }
thead th { border-top: 0; color: var(--soft); font-weight: 500; }
th:first-child { text-align: left; font-weight: 500; }
#frames td:last-child, #frames th:last-child { text-align: left; }
#frames td span { display: block; }
.rejected { color: var(--soft); }
.rejected b { color: var(--model); font-weight: 600; }
@media (max-width: 32rem) { th, td { padding: 0.4rem 0.6rem; } }
sub, sup { line-height: 0; }
@media print { body { background: none; } .box { overflow: visible; } }
"""
