"""`realsim demo --site`: the pages of a session as a folder that any file server hosts."""

import shutil
from pathlib import Path

from realsim.app.console import Console
from realsim.app.truth import LoopErrors
from realsim.pages import Cell, Page
from realsim.store import SessionStore, atomic

PAGES = (
    ("scene.html", "Scene", "Turn the point cloud, the models, the cameras and the grasps in 3D."),
    ("report.html", "Report", "Calibration, poses, grasps and labels: figures, checks, pictures."),
    ("school.html", "School sheet", "Every grasp that was tried, and what it failed on."),
    ("statistics.html", "Statistics", "Counts, beside those of published data sets."),
)
"""File, title and content of every page."""


def write_site(store: SessionStore, errors: LoopErrors, folder: Path, console: Console) -> Path:
    """Write the pages of a session that went through the whole loop; return the first one.

    Nothing on them is loaded from elsewhere, and links are relative.
    """
    from realsim.app.verbs import review, run

    folder.mkdir(parents=True, exist_ok=True)
    with console.stage("site", str(folder)):
        for name in ("report.html", "school.html"):
            shutil.copyfile(store.path(f"reports/{name}"), folder / name)
        review(store.folder, static=folder / "scene.html", quiet=True)
        counts = run("stats", (store.folder,), {"out": folder, "quiet": True}).document
        title = "A capture session, from plan to grasp labels"
        page = Page(title=title, about=f"Made by realsim in a {store.session.name}.")
        drawn = store.path("registration/pictures/overlay.jpg").read_bytes()
        figures = [(value, name) for name, value, goal in errors.rows() if goal]
        figures.append((f"{counts['school']['candidates']:,}", "grasps tried by physics"))
        page.lead(drawn, "What registration found, drawn on photographs.", figures)
        page.section("Pages")
        rows = [[Cell(name, href=f"./{file}"), text] for file, name, text in PAGES]
        page.table(["page", "what it shows"], rows)
        page.section("Make it yourself", "This needs no robot and no camera:")
        page.code("realsim demo --site site")
        atomic.write_bytes(folder / "index.html", page.encode())
    return folder / "index.html"
