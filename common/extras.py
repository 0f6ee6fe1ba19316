"""How to install what an optional part of this package needs."""

from __future__ import annotations

import importlib.metadata
import json
from urllib.parse import unquote, urlsplit

PACKAGE = "ohmskin"


def install_command(extra: str = "") -> str:
    """The command that adds an extra to this installation; empty: that installs all that is always needed.

    An installation from a folder or an address remembers it (PEP 610). Otherwise the command is for the folder of the
    sources.
    """
    wanted = f"[{extra}]" if extra else ""
    try:
        source = json.loads(importlib.metadata.distribution(PACKAGE).read_text("direct_url.json") or "")
        url = str(source["url"])
    except (importlib.metadata.PackageNotFoundError, ValueError, KeyError, TypeError):
        return f"pip install '.{wanted}' in the folder of ohmskin's sources"
    parts = urlsplit(url)
    if parts.scheme != "file":
        return f"pip install '{PACKAGE}{wanted} @ {url}'"
    editable = "-e " if source.get("dir_info", {}).get("editable") else ""
    return f"pip install {editable}'{unquote(parts.path)}{wanted}'"
