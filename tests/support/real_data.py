"""Where the real data lies, and tests that need some of it."""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("REALSIM_DATA", Path(__file__).parents[2] / "../shared/data"))


def needs(path: Path) -> pytest.MarkDecorator:
    """Mark a test of real data, which is skipped where that is not there."""
    return pytest.mark.skipif(not path.exists(), reason=f"no {path} (set REALSIM_DATA)")
