"""The user's folder for what any run can make again: compiled loops, convex parts, verdicts."""

import os
from pathlib import Path


def user_cache(name: str) -> Path:
    """Return where `name` is kept: under `realsim` in `$XDG_CACHE_HOME`, else in `~/.cache`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "realsim" / name
