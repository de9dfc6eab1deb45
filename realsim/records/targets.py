"""The printed targets that a camera is calibrated with, and the points that can be found on them.

Every target is flat. Its frame `board` has the origin at the first point, x along the columns, y
along the rows (down the printed page), so z points INTO the paper (OpenCV's board convention).
Points are numbered row by row from the top left of the page.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError

TagFamily = Literal["tag16h5", "tag25h9", "tag36h10", "tag36h11"]
TAG_CELLS: dict[str, int] = {"tag16h5": 6, "tag25h9": 7, "tag36h10": 8, "tag36h11": 8}
"""Modules along the edge of a tag's black square, its black border of one module included."""
MOST_ROWS = 1000
"""Rows or columns of a printed grid; a file can claim any number."""


def _check_length(value: float, name: str, least: float = 0.0005, most: float = 1.0) -> None:
    """Raise unless a printed length is plausible in metres."""
    if not (np.isfinite(value) and least <= value <= most):
        raise InputError(
            f"{name} is {value} m: metres are expected, between {least:g} and {most:g} m."
            + " Were millimetres given?" * (value > most)
        )


def _check_counts(rows: int, columns: int, least: int, what: str) -> None:
    """Raise unless a grid has enough rows and columns."""
    if not (least <= rows <= MOST_ROWS and least <= columns <= MOST_ROWS):
        raise InputError(
            f"{what} needs {least} to {MOST_ROWS} rows and columns, got {rows}x{columns}."
        )


def _grid(rows: int, columns: int, pitch: float) -> Array:
    """Return (rows * columns, 3) points, row by row."""
    r, c = np.divmod(np.arange(rows * columns), columns)
    return np.stack([c * pitch, r * pitch, np.zeros(len(r))], -1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TagBoard:
    """A flat grid of AprilTags (an AprilGrid); one tag alone is a board of one row and one column.

    Tag (row r, column c) has the id `first_id + r * columns + c`, rows counted from the top of the
    page or, as Kalibr prints it, from the bottom. Points are the tags' corners, four a tag,
    clockwise from the top left as printed.
    """

    rows: int
    columns: int
    tag_size_m: float
    """Edge of a tag's black square [m]."""
    gap_m: float
    """White gap between neighbouring tags [m]."""
    family: TagFamily = "tag36h11"
    first_id: int = 0
    ids_from: Literal["top", "bottom"] = "top"
    """Where the row of the first ids is; Kalibr's AprilGrid counts from the bottom."""
    corner_squares: bool = False
    """Whether black squares fill the gaps between the tags' corners, as on Kalibr's AprilGrid."""

    def __post_init__(self) -> None:
        """Check counts and sizes."""
        _check_counts(self.rows, self.columns, 1, "a tag board")
        if self.family not in TAG_CELLS:
            raise InputError(
                f"the tag family '{self.family}' is not known; {', '.join(TAG_CELLS)} are."
            )
        if not (0.001 <= self.tag_size_m <= 1.0) or not (0.0 < self.gap_m <= 1.0):
            raise InputError(
                f"tag size {self.tag_size_m} m and gap {self.gap_m} m: metres are expected, tags "
                "between 0.001 and 1 m." + " Were millimetres given?" * (self.tag_size_m > 1.0)
            )

    @property
    def ids(self) -> Int64:
        """(rows * columns,) tag ids, row by row from the top of the page."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        if self.ids_from == "bottom":
            row = self.rows - 1 - row
        return self.first_id + row * self.columns + column

    @property
    def corners_board(self) -> Array:
        """(tags, 4, 3) corners in the board frame [m], clockwise from the top left as printed."""
        origin = _grid(self.rows, self.columns, self.tag_size_m + self.gap_m)
        square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)
        return origin[:, None] + square[None] * self.tag_size_m

    @property
    def points_board(self) -> Array:
        """(4 tags, 3) the corners one after the other [m]."""
        return self.corners_board.reshape(-1, 3)

    @property
    def size_m(self) -> tuple[float, float]:
        """Extent along x and y of the outermost corners [m]."""
        pitch = self.tag_size_m + self.gap_m
        return self.columns * pitch - self.gap_m, self.rows * pitch - self.gap_m

    @property
    def half_turn(self) -> bool:
        """Whether the target looks the same turned by 180 deg."""
        return False


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CharucoBoard:
    """A chessboard with ArUco or AprilTag markers in its white squares; points are inner corners.

    The origin is the outer corner of the first square, as in OpenCV, so that the first point lies
    at (square, square).
    """

    rows: int
    """Squares along y."""
    columns: int
    """Squares along x."""
    square_m: float
    """Edge of a square [m]."""
    marker_m: float
    """Edge of a marker's black square [m]."""
    dictionary: str = "DICT_APRILTAG_36h11"
    """Name of one of OpenCV's predefined dictionaries."""
    legacy: bool = False
    """Pattern of OpenCV before 4.6: it differs for an even number of rows."""

    def __post_init__(self) -> None:
        """Check counts and sizes."""
        _check_counts(self.rows, self.columns, 3, "a ChArUco board")
        _check_length(self.square_m, "the ChArUco square")
        _check_length(self.marker_m, "the ChArUco marker")
        if not self.marker_m < self.square_m:
            raise InputError(
                f"the ChArUco marker ({self.marker_m} m) must be smaller than its square "
                f"({self.square_m} m). Were they exchanged?"
            )

    @property
    def points_board(self) -> Array:
        """((rows - 1) (columns - 1), 3) inner corners [m]."""
        inner = _grid(self.rows - 1, self.columns - 1, self.square_m)
        return inner + np.array([self.square_m, self.square_m, 0.0])

    @property
    def size_m(self) -> tuple[float, float]:
        """Extent along x and y of the squares [m]."""
        return self.columns * self.square_m, self.rows * self.square_m

    @property
    def half_turn(self) -> bool:
        """Whether the target looks the same turned by 180 deg."""
        return False


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Chessboard:
    """A plain chessboard; points are its inner corners, the first one the origin."""

    rows: int
    """Inner corners along y."""
    columns: int
    """Inner corners along x."""
    square_m: float
    """Edge of a square [m]."""

    def __post_init__(self) -> None:
        """Check counts and sizes."""
        _check_counts(self.rows, self.columns, 3, "a chessboard (in inner corners)")
        _check_length(self.square_m, "the chessboard's square")

    @property
    def points_board(self) -> Array:
        """(rows * columns, 3) inner corners [m]."""
        return _grid(self.rows, self.columns, self.square_m)

    @property
    def size_m(self) -> tuple[float, float]:
        """Extent along x and y of the inner corners [m]."""
        return (self.columns - 1) * self.square_m, (self.rows - 1) * self.square_m

    @property
    def half_turn(self) -> bool:
        """Whether the target looks the same turned by 180 deg: where rows + columns is even."""
        return (self.rows + self.columns) % 2 == 0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CircleGrid:
    """A grid of dots; points are the dots' centres.

    Symmetric: dot (r, c) at (c, r) * pitch. Asymmetric (OpenCV): dot (r, c) at (2 c + r % 2, r) *
    pitch, so that `pitch_m` is the distance of neighbouring ROWS.
    """

    rows: int
    columns: int
    pitch_m: float
    """Distance of neighbouring dots along x and y; of neighbouring rows where asymmetric [m]."""
    asymmetric: bool = False
    large_origin: bool = False
    """Whether the first dot is larger than the others, which tells the grid from itself turned."""

    def __post_init__(self) -> None:
        """Check counts and sizes."""
        _check_counts(self.rows, self.columns, 3, "a circle grid")
        _check_length(self.pitch_m, "the circle grid's pitch")

    @property
    def points_board(self) -> Array:
        """(rows * columns, 3) centres [m]."""
        if not self.asymmetric:
            return _grid(self.rows, self.columns, self.pitch_m)
        r, c = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return np.stack([2 * c + r % 2, r, np.zeros(len(r))], -1) * self.pitch_m

    @property
    def size_m(self) -> tuple[float, float]:
        """Extent along x and y of the centres [m]."""
        x, y = np.ptp(self.points_board[:, :2], axis=0)
        return float(x), float(y)

    @property
    def half_turn(self) -> bool:
        """Whether the target looks the same turned by 180 deg."""
        return not self.large_origin and (not self.asymmetric or self.rows % 2 == 0)


Target = TagBoard | CharucoBoard | Chessboard | CircleGrid
"""Any printed target."""
