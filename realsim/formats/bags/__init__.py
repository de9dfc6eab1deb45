"""Recordings of ROS1, ROS2 and RealSense as frames: colour, depth, joints and poses joined by time.

`open_bag` checks a recording and says what is in it; `BagSource.frames` reads it in one pass, with
bounded memory, one frame at a time.
"""

from realsim.formats.bags.source import BagSource, open_bag
from realsim.formats.bags.topics import BagChoice

__all__ = ["BagChoice", "BagSource", "open_bag"]
