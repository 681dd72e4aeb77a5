"""Commands that install optional packages, as they work for the Python that is running."""

import json
import shlex
import sys
from importlib.metadata import PackageNotFoundError, distribution
from urllib.parse import unquote, urlsplit


def install_command(extra: str) -> str:
    """The command that adds an extra of geogs, such as ``viewer``, to this installation.

    Where geogs was installed from a folder, the extra is taken from there.
    """
    folder, is_editable = _source()
    words = [sys.executable, "-m", "pip", "install"]
    words += ["-e"] if is_editable else []
    return shlex.join([*words, f"{folder or 'geogs'}[{extra}]"])


def _source() -> tuple[str, bool]:
    """Folder from which geogs was installed, empty for an index; whether it is used in place."""
    try:
        text = distribution("geogs").read_text("direct_url.json")
        found = json.loads(text or "{}")
        url = urlsplit(str(found.get("url", "")))
        is_editable = bool(found.get("dir_info", {}).get("editable", False))
    except (PackageNotFoundError, ValueError, AttributeError, OSError):
        return "", False
    is_folder = url.scheme == "file" and "dir_info" in found
    return (unquote(url.path), is_editable) if is_folder else ("", False)
