"""All formats that `realsim export` writes."""

from realsim.app.export.data_set_targets import DATA_SETS
from realsim.app.export.grasp_targets import GRASPS
from realsim.app.export.scene_targets import SCENES
from realsim.app.export.target import Target

TARGETS: dict[str, Target] = {**DATA_SETS, **SCENES, **GRASPS}
"""By the name that the command line gives them; the command's own list must be the same."""
