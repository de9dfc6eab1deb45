"""Clicks: what each keeps the server busy for, and how soon the first bytes of its answer come."""

import time
from argparse import Namespace
from collections.abc import Callable

import numpy as np
from figures import Found
from review_client import Browser
from review_opening import CLICK_QUIET_S, QUIET_S, USUAL, Server, scene_of, serving

IDLE_S = 1.0
"""How long the server is watched doing nothing."""
IDLE_SHARE = 0.05
"""It does nothing where it takes less of a core: what is prepared after the opening is done."""
LONGEST_PREPARING_S = 30
ANSWER_S = 2.0
"""A click that is not answered by then changes nothing that is shown: it does not count."""
ROUNDS, QUICK_ROUNDS = 5, 2
"""Times every kind is clicked."""
Click = tuple[str, Callable[[], None]]


def clicks(arguments: Namespace) -> Found:
    """Click everything a reviewer clicks, with 100,000 points and 256 frustums in the page."""
    found = Found()
    with serving(scene_of(arguments), USUAL) as server:
        browser = Browser.open(server.url)
        browser.until_scene(QUIET_S)
        _idle_share(server)
        # The first click of a kind starts preparing for the next ones, in the background.
        first = [_measured(server, browser, click, 0.0)[1] for _, click in _kinds(browser)]
        idle = _idle_share(server)
        rows: dict[str, list[tuple[float, float]]] = {}
        for _ in range(QUICK_ROUNDS if arguments.quick else ROUNDS):
            for name, click in _kinds(browser):
                rows.setdefault(name, []).append(_measured(server, browser, click, idle))
        browser.close()
    rows = {name: times for name, times in rows.items() if np.isfinite(times).all()}
    busy = {name: 1e3 * float(np.median([b for b, _ in times])) for name, times in rows.items()}
    wall = {name: 1e3 * float(np.median([w for _, w in times])) for name, times in rows.items()}
    slowest = max(busy, key=lambda name: busy[name])
    found.add("click_ms", busy[slowest], f"the slowest of {len(busy)} kinds, '{slowest}'; medians")
    found.add("click_median_ms", float(np.median(list(busy.values()))), "over the kinds")
    found.add("click_wall_ms", max(wall.values()), "until the first bytes, the slowest kind")
    found.add("click_first_wall_ms", 1e3 * float(np.nanmax(first)), "the first click of a kind")
    found.cases["clicks_ms"] = {k: [round(busy[k], 1), round(wall[k], 1)] for k in busy}
    slow_first = sorted(busy, key=lambda name: -busy[name])
    listed = ", ".join(f"{k} {busy[k]:.0f} ({wall[k]:.0f})" for k in slow_first)
    found.notes.append(f"busy for, and first bytes after [ms]: {listed}")
    return found


def _idle_share(server: Server) -> float:
    """Wait until the server does nothing; return the share of a core that it still takes."""
    share = 1.0
    for _ in range(LONGEST_PREPARING_S):
        start = server.cost()
        time.sleep(IDLE_S)
        share = (server.cost().cpu_s - start.cpu_s) / IDLE_S
        if share < IDLE_SHARE:
            break
    return share


def _kinds(browser: Browser) -> list[Click]:
    """Return what is clicked, in the order of one round."""
    kinds: list[Click] = []

    def press(name: str, label: str, kind: str, value: object) -> None:
        uuid = browser.control(label, kind)
        if uuid is not None:
            kinds.append((name, lambda: browser.set(uuid, value)))

    button, box, choice = "GuiButtonMessage", "GuiCheckboxMessage", "GuiDropdownMessage"
    objects = [m for m in browser.of_type("GlbMessage") if m["name"].endswith("/appearance")]
    for k, message in enumerate(objects[:2]):
        name, owner = str(message["name"]), str(message["owner"])
        kinds.append((f"object {k}", lambda n=name, o=owner: browser.click_node(n, o)))
    press("accept", "Accept", button, True)
    press("undo", "Undo", button, True)
    press("reject", "Reject", button, True)
    press("cameras off", "Cameras", box, False)
    press("cameras on", "Cameras", box, True)
    press("points off", "Measured points", box, False)
    press("points on", "Measured points", box, True)
    press("verdicts", "Objects", choice, "in the colour of the verdict")
    press("looks", "Objects", choice, "as they look")
    press("grasps on", "Show grasps", box, True)
    press("grasps of one", "Of", choice, "this object")
    press("grasps of all", "Of", choice, "all objects")
    press("reachable", "The arm reaches it", box, True)
    press("all grasps", "The arm reaches it", box, False)
    press("grasps off", "Show grasps", box, False)
    frustums = browser.of_type("CameraFrustumMessage")
    if frustums:
        name, owner = str(frustums[40 % len(frustums)]["name"]), str(frustums[0]["owner"])
        kinds.append(("camera", lambda: browser.click_node(name, owner)))
    return kinds


def _measured(
    server: Server, browser: Browser, click: Callable[[], None], idle: float
) -> tuple[float, float]:
    """Return for how long a click keeps the server busy, and when its first bytes come [s].

    What the server does anyway while nothing is clicked is taken off.
    """
    before, start = server.cost().cpu_s, time.perf_counter()
    click()
    answered = browser.receive(ANSWER_S)
    first = time.perf_counter() - start
    browser.until_quiet(CLICK_QUIET_S)
    lasted = time.perf_counter() - start
    busy = server.cost().cpu_s - before - idle * lasted
    return max(busy, 0.0), first if answered else float("nan")
