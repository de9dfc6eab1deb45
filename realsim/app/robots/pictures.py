"""Pictures of arms and hands: the bodies that everything is computed with."""

from itertools import product

import numpy as np

from realsim.arrays import Image
from realsim.geometry import se3
from realsim.models.model_picture_views import parts_mesh, rendered, view_of
from realsim.records import Mesh
from realsim.robots.arm import RobotArm
from realsim.robots.hand import Hand
from realsim_capture_plans.pictures.arm_looks import shape_mesh

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
