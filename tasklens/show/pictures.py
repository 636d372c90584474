"""Pages as single files: templates with the style sheet, pictures and files as data URIs."""

import base64
import io
from importlib import resources
from pathlib import Path
from typing import Any

import numpy
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

_TYPES = {".svg": "image/svg+xml", ".webp": "image/webp", ".png": "image/png"}
_DOWNLOAD = "application/octet-stream"
_QUALITY = 82  # of WebP


def render(package: str, template: str, **values: Any) -> str:
    """Return a page as HTML, from the template of a package, the style sheet `css`, and further values."""
    environment = Environment(
        loader=PackageLoader(package, "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    css = (resources.files(__package__) / "page.css").read_text(encoding="utf-8")
    return environment.get_template(template).render(css=css, **values)


def link(path: Path) -> str:
    """Return a file as a data URI."""
    return _data(_TYPES.get(path.suffix, _DOWNLOAD), path.read_bytes())


def of_array(image: numpy.ndarray) -> str:
    """Return an image (3, H, W) of uint8 as a data URI."""
    buffer = io.BytesIO()
    Image.fromarray(numpy.ascontiguousarray(image.transpose(1, 2, 0))).save(buffer, "webp", quality=_QUALITY)
    return _data("image/webp", buffer.getvalue())


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def of_text(text: str, suffix: str = ".yaml") -> str:
    """Return a text as a data URI: an image if its suffix is that of one, otherwise a download."""
    return _data(_TYPES.get(suffix, _DOWNLOAD), text.encode())
