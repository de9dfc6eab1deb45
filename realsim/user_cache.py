"""The user's folder for what any run can make again: compiled loops, convex parts, verdicts."""

import os
from pathlib import Path


def home() -> Path:
    """Return the user's folder; of a user who has none, one that nothing can lie in."""
    return Path(os.path.expanduser("~").lstrip("~") or os.devnull)


def user_cache(name: str) -> Path:
    """Return where `name` is kept: under `realsim` in `$XDG_CACHE_HOME`, else in `~/.cache`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or home() / ".cache") / "realsim" / name
