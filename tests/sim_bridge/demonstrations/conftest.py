"""One school whose attempts succeed, slip and are lost, for all tests of demonstrations."""

from pathlib import Path

import pytest

from realsim.app.school.files import stored_grasps
from realsim_sim_bridge.demonstrations.front_view import FrontView, wrist_camera
from realsim_sim_bridge.demonstrations.source import DemonstrationSource

SMALL = (64, 48)


@pytest.fixture(scope="session")
def source(weak_school: Path) -> DemonstrationSource:
    """Its attempts, with small pictures."""
    grasps, models = stored_grasps(weak_school)
    cameras = (FrontView(size_px=SMALL), wrist_camera(None, SMALL))
    return DemonstrationSource(grasps, models, cameras=cameras, cache=weak_school / "grasps/cache")
