"""What the stages found, as tables and notes on the console."""

from dataclasses import replace

from realsim.app.console import Console
from realsim.app.stages import session_models
from realsim.records import Scene
from realsim.store import SessionStore


def show_scene(store: SessionStore, scene: Scene, console: Console) -> None:
    """Print what was registered, worst first, what was not, and what to do next.

    What only the session knows (pixels, cameras, findings) is left out where its scene is another.
    """
    from realsim.app.register.results import REPORT_FILE, load_registered, stand_alone
    from realsim.app.register.tables import show_registered

    stored = load_registered(store) if store.has(REPORT_FILE) else None
    known = stored is not None and stored.scene.name == scene.name
    result = replace(stored, scene=scene) if stored is not None and known else stand_alone(scene)
    show_registered(store.folder, result, session_models(store), console)
