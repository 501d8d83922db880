"""Pages from templates: one file without outside address, every text escaped."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from flashdex.errors import FlashdexError
from flashdex.reports.text import duration, number, shorten
from flashdex.system.files import write_atomic


def render(template: str, **content: Any) -> Markup:
    """Fill a file of ``templates/``; what is no ``Markup`` is escaped on its way in."""
    return Markup(_ENVIRONMENT.get_template(template).render(content))


def write_page(
    path: Path, template: str, *, error: type[FlashdexError], **content: Any
) -> Path:
    """Write a page from a file of ``templates/``, complete or not at all.

    Raises:
        FlashdexError: of the class ``error``; the page cannot be written.
    """
    # half of a surrogate pair in a name is no character and cannot be written
    text = render(template, **content).encode("utf-8", errors="replace").decode("utf-8")
    try:
        write_atomic(path, text)
    except OSError as fault:
        raise error(f"{path}: cannot be written ({fault.strerror}).") from fault
    return path


def _breakable(name: str) -> Markup:
    """Long names may be broken after an underscore, and only there."""
    return escape(name).replace("_", Markup("_<wbr>"))


def _inline(content: bytes, media: str) -> Markup:
    """A file as a ``data:`` address."""
    return Markup(f"data:{media};base64,{base64.b64encode(content).decode('ascii')}")


_ENVIRONMENT = Environment(
    loader=PackageLoader("flashdex.reports"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {
    "breakable": _breakable,
    "duration": duration,
    "inline": _inline,
    "number": number,
    "px": "{:.1f}".format,
    "shorten": shorten,
}
