"""One school whose attempts succeed, slip and are lost, for all tests of demonstrations."""

from pathlib import Path

import pytest

from realsim.app.school.files import stored_grasps
from realsim_sim_bridge.demonstrations.front_view import FrontView, wrist_camera
from realsim_sim_bridge.demonstrations.source import DemonstrationSource
from school_sessions import tried_weakly

SMALL = (64, 48)


@pytest.fixture(scope="session")
def school(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session that was tried with a weak hand."""
    return tried_weakly(tmp_path_factory.mktemp("weak") / "session", grasps=14)


@pytest.fixture(scope="session")
def source(school: Path) -> DemonstrationSource:
    """Its attempts, with small pictures."""
    grasps, models = stored_grasps(school)
    cameras = (FrontView(size_px=SMALL), wrist_camera(None, SMALL))
    return DemonstrationSource(grasps, models, cameras=cameras, cache=school / "grasps/cache")
