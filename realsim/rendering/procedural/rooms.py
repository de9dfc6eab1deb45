"""Rooms as panoramas: walls, furniture, lamps under the ceiling and windows to the day.

The walls are lit by the lamps and windows themselves (form factors of points on them) and by what
the room throws back (its mean reflectance in a geometric series), as an integrating sphere would.
Radiances are in kcd/m^2.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry.colors import light_of_bytes
from realsim.rendering.appearance import Environment
from realsim.rendering.procedural.skies import directions, planck

HEIGHT = 256
EYE_M = 1.1
"""Height of the panorama's middle over the floor: a camera over a table [m]."""
WALLS = ((238, 236, 230), (226, 222, 212), (204, 214, 220), (214, 206, 190), (190, 200, 190))
FLOORS = ((150, 122, 92), (126, 126, 128), (86, 66, 50), (180, 172, 160), (70, 74, 80))
FURNITURE = ((112, 82, 56), (52, 54, 58), (206, 206, 204), (92, 116, 138), (150, 60, 48))
GRID = 24
"""Points per edge of a wall at which the light on it is found."""
SAMPLES = 4
"""Points per edge of a lamp that stand for its light."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Panel:
    """A rectangle on a face of the room."""

    face: int
    """0, 1: wall at -x, +x; 2, 3: wall at -y, +y; 4: floor; 5: ceiling."""
    low: Array
    """(2,) least corner along the face's two axes [m]."""
    high: Array
    """(2,) greatest corner [m]."""
    radiance: Array | None = None
    """(3,) of a lamp or window; None = it does not shine."""
    paint: Array | None = None
    """(3,) linear reflectance of furniture."""


def face_axes(face: int) -> tuple[int, int, int]:
    """Return a face's normal axis and the two axes along it."""
    normal = face // 2
    along, across = (k for k in range(3) if k != normal)
    return normal, along, across


def room(rng: np.random.Generator) -> Environment:
    """Return a room with 1 to 6 lamps and windows, their colours from warm to cold."""
    half = np.array([rng.uniform(2.0, 5.0), rng.uniform(2.0, 5.0), 0.0])
    eye = np.array([*(0.45 * rng.uniform(-1, 1, 2) * half[:2]), 0.0])
    low = np.array([-half[0], -half[1], -EYE_M]) - eye
    high = np.array([half[0], half[1], rng.uniform(2.5, 3.4) - EYE_M]) - eye
    paints = np.array(
        [*(light_of_bytes(WALLS[k]) for k in rng.integers(len(WALLS), size=4)),
         light_of_bytes(FLOORS[int(rng.integers(len(FLOORS)))]),
         light_of_bytes((240, 240, 238))]
    )  # fmt: skip
    if rng.random() < 0.7:
        paints[:4] = paints[0]
    panels = _furniture(rng, low, high) + _lights(rng, low, high)
    panorama = _seen(low, high, paints, panels)
    windows = sum(p.radiance is not None and p.face < 4 for p in panels)
    lamps = sum(p.radiance is not None and p.face == 5 for p in panels)
    return Environment(
        panorama=panorama.astype(np.float32),
        sun_direction=(0.0, 0.0, 1.0),
        name=f"room with {lamps} lamps and {windows} windows",
    )


def _lights(rng: np.random.Generator, low: Array, high: Array) -> list[Panel]:
    """Return lamps on the ceiling and windows in one wall, 1 to 6 in all."""
    count = int(rng.integers(1, 7))
    windows = int(rng.integers(0, min(count, 3) + 1)) if rng.random() < 0.65 else 0
    lamps = count - windows
    kelvin = float(rng.choice([2700.0, 3000.0, 3500.0, 4000.0, 5000.0, 6500.0]))
    out: list[Panel] = []
    size = np.array([rng.uniform(0.25, 0.7), rng.uniform(0.25, 1.4)])
    if rng.random() < 0.5:
        size = size[::-1]
    bright = 1.4 / float(size[0] * size[1]) * rng.uniform(0.5, 1.3)
    columns = max(1, int(np.ceil(np.sqrt(lamps))))
    rows = max(1, -(-lamps // columns))
    for k in range(lamps):
        cell = np.array([(k % columns + 0.5) / columns, (k // columns + 0.5) / rows])
        middle = low[:2] + cell * (high - low)[:2] + rng.uniform(-0.2, 0.2, 2)
        # One tube of a set is often older than the others.
        color = planck(kelvin * float(rng.uniform(0.95, 1.05)))
        out.append(Panel(face=5, low=middle - size / 2, high=middle + size / 2,
                         radiance=bright * color))  # fmt: skip
    if windows:
        face = int(rng.integers(4))
        along = face_axes(face)[1]
        day = planck(rng.uniform(5500, 9500)) * rng.uniform(0.6, 4.0)
        wide = (high[along] - low[along]) / windows
        sill, top = rng.uniform(-0.3, 0.1), min(float(rng.uniform(0.9, 1.3)), high[2] - 0.15)
        for k in range(windows):
            start = low[along] + wide * (k + 0.15)
            out.append(Panel(face=face, low=np.array([start, sill]),
                             high=np.array([start + 0.7 * wide, top]), radiance=day))  # fmt: skip
    return out


def _furniture(rng: np.random.Generator, low: Array, high: Array) -> list[Panel]:
    """Return doors, cupboards and pictures on the walls: what mirrors in shiny things."""
    out: list[Panel] = []
    for face in range(4):
        along = face_axes(face)[1]
        for _ in range(int(rng.integers(0, 4))):
            wide = rng.uniform(0.5, 1.6)
            start = rng.uniform(low[along], max(high[along] - wide, low[along] + 0.1))
            hangs = rng.random() < 0.35
            bottom = rng.uniform(0.0, 0.5) if hangs else low[2]
            top = bottom + rng.uniform(0.4, 0.8) if hangs else rng.uniform(-0.3, 1.0)
            paint = light_of_bytes(FURNITURE[int(rng.integers(len(FURNITURE)))])
            corner = np.array([start + wide, min(top, high[2])])
            out.append(Panel(face=face, low=np.array([start, bottom]), high=corner, paint=paint))
    return out


def _seen(low: Array, high: Array, paints: Array, panels: list[Panel]) -> Array:
    """Return what is seen (H, 2H, 3) from the origin inside the room."""
    view = directions(HEIGHT)
    with np.errstate(divide="ignore"):
        reach = np.where(view > 0, high, low) / np.where(view == 0, 1e-12, view)
    normal = np.argmin(reach, axis=-1)
    distance = np.take_along_axis(reach, normal[..., None], -1)
    at = view * distance
    side = np.take_along_axis(view, normal[..., None], -1)[..., 0] > 0
    face = 2 * normal + side
    back = _thrown_back(low, high, paints, panels)
    out = np.zeros((*view.shape[:2], 3))
    for f in range(6):
        here = face == f
        _, a, b = face_axes(f)
        points = at[here][:, [a, b]]
        paint = np.broadcast_to(paints[f], (len(points), 3)).copy()
        shines = np.zeros((len(points), 3))
        for p in (p for p in panels if p.face == f):
            inside = np.all((points >= p.low) & (points <= p.high), axis=-1)
            if p.paint is not None:
                paint[inside] = p.paint
            if p.radiance is not None:
                paint[inside], shines[inside] = 0.0, p.radiance
        light = _on_face(f, points, low, high, panels) + back
        out[here] = shines + paint * light
    return out


def _lamp_points(panel: Panel, low: Array, high: Array) -> tuple[Array, float]:
    """Return points (SAMPLES^2, 3) spread over a lamp, and the area each stands for [m^2]."""
    normal, a, b = face_axes(panel.face)
    step = (np.arange(SAMPLES) + 0.5) / SAMPLES
    s, t = (x.ravel() for x in np.meshgrid(step, step))
    points = np.empty((SAMPLES**2, 3))
    points[:, normal] = (high if panel.face % 2 else low)[normal]
    points[:, a] = panel.low[0] + s * (panel.high - panel.low)[0]
    points[:, b] = panel.low[1] + t * (panel.high - panel.low)[1]
    return points, float(np.prod(panel.high - panel.low)) / SAMPLES**2


def _on_face(face: int, points: Array, low: Array, high: Array, panels: list[Panel]) -> Array:
    """Return the light (N, 3) that lamps throw on points (N, 2) of a face: irradiance / pi."""
    from scipy.ndimage import map_coordinates

    normal, a, b = face_axes(face)
    grid = np.empty((GRID, GRID, 3))
    step = np.linspace(0, 1, GRID)
    grid[..., normal] = (high if face % 2 else low)[normal]
    grid[..., a] = (low[a] + step * (high - low)[a])[None, :]
    grid[..., b] = (low[b] + step * (high - low)[b])[:, None]
    total = np.zeros((GRID, GRID, 3))
    for p in panels:
        if p.radiance is None or p.face == face:
            continue
        lamp, area = _lamp_points(p, low, high)
        gap = lamp[:, None, None, :] - grid
        square = np.maximum(np.sum(gap**2, -1), 0.02)
        facing = np.abs(gap[..., normal]) * np.abs(gap[..., p.face // 2]) / square**2
        total += (facing.sum(0) * area / np.pi)[..., None] * p.radiance
    along = [b, a]
    at = ((points[:, ::-1] - low[along]) / (high - low)[along] * (GRID - 1)).T
    return np.stack(
        [map_coordinates(total[..., k], at, order=1, mode="nearest") for k in range(3)], -1
    )


def _thrown_back(low: Array, high: Array, paints: Array, panels: list[Panel]) -> Array:
    """Return the even light (3,) that the walls throw back and forth, as irradiance / pi."""
    size = high - low
    areas = np.array([np.prod(np.delete(size, f // 2)) for f in range(6)])
    mean = np.clip(areas @ paints / areas.sum() * 0.85, 0, 0.8)
    power = np.zeros(3)
    for p in panels:
        if p.radiance is not None:
            power += float(np.prod(p.high - p.low)) * p.radiance
    return mean / (1 - mean) * power / areas.sum()
