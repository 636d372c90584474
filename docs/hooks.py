"""Hook of mkdocs: links to files outside of `docs` become plain names."""

import re
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).parents[1]
_LINK = re.compile(r"(!?)\[([^\]]+)\]\((?!https?:|#|mailto:)([^)#]+)(?:#[^)]*)?\)")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn links to files outside of `docs` into plain names.

    Raises:
        FileNotFoundError: a link to a file that is not in the repository.
    """
    folder = PurePosixPath("docs", page.file.src_uri).parent
    return _LINK.sub(lambda link: _plain(link, ROOT / folder), markdown)


def _plain(link: re.Match, folder: Path) -> str:
    target = (folder / link[3]).resolve()
    if (ROOT / "docs") in target.parents and target.suffix != ".yaml":
        return link[0]
    if not target.exists():
        raise FileNotFoundError(f"{link[0]}: there is no {target}")
    return link[2] if link[2].startswith("`") else f"`{link[2]}`"
