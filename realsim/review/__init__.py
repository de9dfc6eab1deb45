"""The web review: look at a registered session in the browser and judge every object."""

import sys
from types import ModuleType
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


class ReviewPackage(ModuleType):
    """The package, which is the verb `rs.review(...)` as well: Python gives both one name."""

    def __call__(self, *sessions: Any, **options: Any) -> Any:
        """Do what `realsim.app.verbs.review` does."""
        from realsim import __getattr__ as promised

        return promised("review")(*sessions, **options)


sys.modules[__name__].__class__ = ReviewPackage
