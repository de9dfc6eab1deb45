"""The web review: look at a registered session in the browser and judge every object."""

from typing import TYPE_CHECKING, Any

from realsim.review.corrections import reviewed_scene
from realsim.review.journal import ReviewState, replay

if TYPE_CHECKING:
    from realsim.review.drawing.scene_nodes import SceneConfig
    from realsim.review.server import ReviewServer

__all__ = ["ReviewServer", "ReviewState", "SceneConfig", "replay", "reviewed_scene"]


def __getattr__(name: str) -> Any:
    """Load the server on first use: viser stays out of `import realsim.review`."""
    if name in ("ReviewServer", "SceneConfig"):
        from realsim.review import server

        return getattr(server, name)
    raise AttributeError(f"module 'realsim.review' has no attribute '{name}'")
