"""List the robots that are found by name; prove one.

Pictures of arms and hands: the bodies that everything is computed with.
"""

from itertools import product
from pathlib import Path

import numpy as np

from realsim.app.console import Console
from realsim.arrays import Image
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim.models.model_picture_views import parts_mesh, rendered, view_of
from realsim.pages import Cell, Page
from realsim.records import Mesh
from realsim.robots.arm import RobotArm, find_arm
from realsim.robots.check_arm import Finding, check_arm
from realsim.robots.hand import Hand, find_hand
from realsim.robots.robot_files import KINDS, kind_of, names_of
from realsim.store.atomic import write_bytes
from realsim_capture_plans.pictures.arm_chart import shape_mesh

SIZE_PX = (420, 420)
LINKS = ((96, 112, 128), (176, 188, 200))
"""Colours of the links, by turns."""
PALM, FINGER = (120, 132, 144), (214, 148, 84)
ARM_FROM, HAND_FROM = (1.0, -1.4, 0.55), (1.2, 0.75, -0.5)
"""Where the camera stands."""


def robot_picture(robot: RobotArm | Hand) -> Image:
    """Return an arm at home; of a hand, three openings side by side."""
    if isinstance(robot, RobotArm):
        return _drawn(_arm_parts(robot), ARM_FROM)
    openings = (robot.max_opening_m, robot.max_opening_m / 2, 0.0)
    pictures = [_hand_parts(robot, opening) for opening in openings]
    return np.concatenate([_drawn(parts, HAND_FROM) for parts in pictures], axis=1)


def _drawn(parts: list[Mesh], direction: tuple[float, float, float]) -> Image:
    points = np.concatenate([part.vertices for part in parts])
    return rendered(parts, view_of(points, direction, SIZE_PX))[0]


def _arm_parts(arm: RobotArm) -> list[Mesh]:
    frames = arm.chain.nominal().link_frames(arm.home)
    return [
        parts_mesh(
            se3.transform(frames[shape.frame] @ shape.T_frame_shape, shape_mesh(shape)[0]),
            LINKS[shape.frame % 2],
        )
        for shape in arm.shapes
    ]


def _hand_parts(hand: Hand, opening_m: float) -> list[Mesh]:
    boxes = hand.boxes(opening_m)[0]
    palms = len(hand.palm_boxes)
    return [
        parts_mesh(np.array(list(product(*np.stack(box, axis=1)))), PALM if k < palms else FINGER)
        for k, box in enumerate(boxes)
    ]


HEADER = ["name", "robot", "joints", "reach or opening", "payload or force"]


def list_robots(page: Path, console: Console) -> None:
    """Print all robots that are found by name, and write the page with their pictures."""
    rows: list[list[str]] = []
    document = Page(title="realsim robots", about="found by name: --arm, --hand")
    for kind in KINDS:
        title = f"{kind.capitalize()}s"
        document.section(title, key=kind)
        with console.stage(f"draw the {title.lower()}") as tick:
            names = names_of(kind)
            for k, name in enumerate(names):
                try:
                    robot = find_arm(name) if kind == "arm" else find_hand(name)
                    picture = robot_picture(robot)
                except RealsimError as error:
                    rows.append([name, f"cannot be used: {error}", "", "", ""])
                    document.text(f"{name}: {error}", "note")
                    continue
                rows.append(_row(name, robot))
                document.picture(picture, f"{name}: {robot.title}; {_told(robot)}")
                tick(k + 1, len(names))
    write_bytes(page, document.encode())
    console.table("Robots", HEADER, rows)
    console.say(f"pictures: {page}")
    console.result({"robots": [dict(zip(HEADER, row, strict=True)) for row in rows], "page": page})


def check_robot(name: str, page: Path | None, console: Console) -> bool:
    """Print what was found of a robot, and return whether all is right.

    Raises:
        InputError: there is no such robot, or its files do not make one.
    """
    robot: RobotArm | Hand
    findings: list[Finding]
    if kind_of(name) == "arm":
        robot, findings = check_arm(name)
    else:
        from realsim.robots.check_hand import check_hand

        robot, findings = check_hand(name)
    wrong = [f for f in findings if not f.is_right]
    rows = [[f.what, f.found, "right" if f.is_right else "WRONG"] for f in findings]
    console.table(f"{robot.title} ({robot.name})", ["what", "found", ""], rows)
    for finding in wrong:
        console.warn(f"{finding.what}: {finding.found}. {finding.advice}")
    console.say("nothing is wrong." if not wrong else f"{len(wrong)} of {len(findings)} are wrong.")
    console.result({"name": robot.name, "right": not wrong, "findings": findings})
    if page is not None:
        write_bytes(page, _check_page(robot, findings).encode())
        console.say(f"page: {page}")
    return not wrong


def _check_page(robot: RobotArm | Hand, findings: list[Finding]) -> Page:
    page = Page(title=f"realsim robots: {robot.name}", about=f"{robot.title}; {_told(robot)}")
    wrong = [f for f in findings if not f.is_right]
    kind, title = ("bad", f"{len(wrong)} wrong.") if wrong else ("good", "Nothing is wrong.")
    page.verdict(kind, title, "", [[f.what, f.advice] for f in wrong])
    page.picture(robot_picture(robot), robot.title)
    marks = {True: Cell("right", kind="good"), False: Cell("wrong", kind="bad")}
    page.table(["what", "found", ""], [[f.what, f.found, marks[f.is_right]] for f in findings])
    return page


def _row(name: str, robot: RobotArm | Hand) -> list[str]:
    if isinstance(robot, Hand):
        size = f"{1e3 * robot.max_opening_m:.0f} mm"
        force = f"{robot.least_force_n:g} to {robot.greatest_force_n:g} N"
        return [name, robot.title, "", size, force]
    size, payload = f"{robot.reach_m:.2f} m", f"{robot.payload_kg:g} kg"
    return [name, robot.title, str(robot.joints), size, payload]


def _told(robot: RobotArm | Hand) -> str:
    """Return the row's figures as a sentence's end."""
    row = _row("", robot)
    if isinstance(robot, Hand):
        law = (
            f"arc of {1e3 * robot.arc_radius_m:.1f} mm" if robot.arc_radius_m else "parallel slide"
        )
        return f"opens {row[3]}, {law}, {row[4]}"
    return f"{row[2]} joints, reaches {row[3]}, carries {row[4]}"
