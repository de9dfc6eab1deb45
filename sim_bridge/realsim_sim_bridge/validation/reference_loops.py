"""The reference contact model's inner loop: one pair of hand and object, step by step.

Spheres of the pads meet the triangles of the object's parts, points of its surface the boxes of the
hand. A contact that is d deep and slides at v_t presses and rubs by

    N = max(0, k d + c d')                                 k [N/m] and c [N s/m]
    T = k_t x + c v_t,  |T| <= mu N,   with a bristle x' = v_t,  |k_t x| <= mu N

(Cundall & Strack 1979). Speeds are stepped by the forces, positions by the new speeds.
"""

from typing import Any

import numpy as np

from realsim.arrays import Array, Rows
from realsim.compiled import njit

Vector = tuple[float, float, float]
Frame = tuple[Vector, Vector, Vector]

SKIN_M = 1e-3
"""What is no farther apart than this is looked at [m], until something moved that far."""
SEAM_M = 1e-7
"""A point so far outside another part still belongs to the seam between them [m]."""
TIE_M2 = 1e-14
"""Triangles are equally near where their squared distances differ by less [m^2]."""

# A pair's state (20,): position of the centre of mass 0:3 and quaternion w x y z 3:7 of the
# principal frame, velocity 7:10 and angular velocity 10:13, all in the hand's axes; the fingers'
# distance from the middle 13, its speed 14, the pads' height 15; normal force of each finger 16:18;
# kinetic and stored energy 18; the deepest that a sphere sank in 19.
SIZE = 20
QUATERNION, SPEEDS, FORCES = slice(3, 7), slice(7, 13), slice(16, 18)
FINGER, FINGER_SPEED, HEIGHT, ENERGY, DEEPEST = 13, 14, 15, 18, 19


@njit(error_model="numpy")
def _at(a: Any, i: int = 0) -> Vector:
    return a[i], a[i + 1], a[i + 2]


@njit(error_model="numpy")
def _put(a: Array, i: int, v: Vector) -> None:
    a[i], a[i + 1], a[i + 2] = v


@njit(error_model="numpy")
def _times(s: float, a: Vector) -> Vector:
    return s * a[0], s * a[1], s * a[2]


@njit(error_model="numpy")
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(error_model="numpy")
def _plus(a: Vector, s: float, b: Vector) -> Vector:
    """Return a + s b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


@njit(error_model="numpy")
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(error_model="numpy")
def _turn(R: Frame, v: Vector) -> Vector:
    return _dot(R[0], v), _dot(R[1], v), _dot(R[2], v)


@njit(error_model="numpy")
def _turn_back(R: Frame, v: Vector) -> Vector:
    return _plus(_plus(_times(v[0], R[0]), v[1], R[1]), v[2], R[2])


@njit(error_model="numpy")
def _rotation(w: float, x: float, y: float, z: float) -> Frame:
    """Return the rows of a unit quaternion's matrix."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@njit(error_model="numpy")
def closest(p: Vector, t: Array) -> tuple[float, Vector]:
    """Return the squared distance to the nearest point of a triangle (3, 3), and that point.

    By the regions of its corners, edges and face (Ericson 2005, "Real-Time Collision Detection").
    """
    a, b, c = _at(t[0]), _at(t[1]), _at(t[2])
    ab, ac = _plus(b, -1.0, a), _plus(c, -1.0, a)
    d1, d2 = _dot(ab, _plus(p, -1.0, a)), _dot(ac, _plus(p, -1.0, a))
    d3, d4 = _dot(ab, _plus(p, -1.0, b)), _dot(ac, _plus(p, -1.0, b))
    d5, d6 = _dot(ab, _plus(p, -1.0, c)), _dot(ac, _plus(p, -1.0, c))
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    v, w = 0.0, 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        pass
    elif d3 >= 0.0 and d4 <= d3:
        v = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    found = _plus(_plus(a, v, ab), w, ac)
    away = _plus(p, -1.0, found)
    return _dot(away, away), found


@njit(error_model="numpy")
def _list_near(
    center: Vector, reach: float, triangles: Array, first: Rows, near: Rows, counts: Rows
) -> None:
    """List the triangles of each part within reach of a point: near (T,), counts (P,)."""
    for p in range(len(first) - 1):
        counts[p] = 0
        for t in range(first[p], first[p + 1]):
            if closest(center, triangles[t])[0] < reach * reach:
                near[first[p] + counts[p]] = t
                counts[p] += 1


@njit(error_model="numpy")
def _sink(  # noqa: PLR0913, PLR0917 - compiled code takes plain arrays
    center: Vector, radius: float, triangles: Array, normals: Array, first: Rows, near: Rows,
    counts: Rows, depths: Array, points: Array, outwards: Array,
) -> None:  # fmt: skip
    """Note how deep a sphere is in each part (P,), at which point and along which normal (P, 3).

    Where parts meet, what is inside another one is no surface of the object.
    """
    for p in range(len(depths)):
        depths[p], best, face, over = -1.0, np.inf, 0, 0.0
        for k in range(first[p], first[p] + counts[p]):
            squared, found = closest(center, triangles[near[k]])
            if squared < best + TIE_M2:
                above = _dot(_at(normals[near[k]]), _plus(center, -1.0, found))
                # Beyond an edge or a corner a point is above one of the faces, not above them all.
                if squared < best - TIE_M2 or above > over:
                    best, face, over = squared, near[k], above
                    _put(points[p], 0, found)
        if best == np.inf:
            continue
        away, out = _plus(center, -1.0, _at(points[p])), _at(normals[face])
        distance = np.sqrt(best) if over >= 0.0 else -np.sqrt(best)
        depths[p] = radius - distance
        far = abs(distance) > 1e-6 * radius
        _put(outwards[p], 0, _times(1.0 / distance, away) if far else out)
    for p in range(len(depths)):
        for other in range(len(depths)):
            deeper = depths[other] > depths[p] or (depths[other] == depths[p] and other < p)
            if depths[p] > 0.0 and other != p and deeper:
                inside, q = True, _at(points[p])
                for t in range(first[other], first[other + 1]):
                    inside &= _dot(_at(normals[t]), q) + normals[t, 3] <= SEAM_M
                if inside:
                    depths[p] = -1.0


@njit(error_model="numpy")
def _below(point: Vector, box: Array, face: int) -> float:
    """Return how far a point is below a face of a box (2, 3): 0 to 2 high ones, 3 to 5 low."""
    return box[1, face] - point[face] if face < 3 else point[face - 3] - box[0, face - 3]


@njit(error_model="numpy")
def _nearest(point: Vector, box: Array) -> int:
    """Return the face of a box (2, 3) below which a point is least, or above which it is most."""
    face = 0
    for other in range(1, 6):
        if _below(point, box, other) < _below(point, box, face):
            face = other
    return face


@njit(error_model="numpy")
def _shift(box: Array, side: float, state: Array, out: Array) -> None:
    """Put a box (2, 3) of the closed hand where the finger is."""
    for i in range(2):
        out[i, 0] = box[i, 0]
        out[i, 1] = box[i, 1] + side * state[FINGER]
        out[i, 2] = box[i, 2] + abs(side) * state[HEIGHT]


@njit(error_model="numpy")
def _press(  # noqa: PLR0913, PLR0917 - compiled code takes plain arrays
    state: Array, sums: Array, bristle: Array, x: Vector, n: Vector, depth: float,
    side: float, slope: float, dt: float, pad: Array,
) -> None:  # fmt: skip
    """Add what a contact does to the sums.

    Args:
        state: (SIZE,) of the pair; its fingers' forces are added to.
        sums: (8,) torque and force on the object, force that opens the fingers, stored energy.
        bristle: (3,) how far it is bent [m]; changed.
        x: where, from the object's centre [m].
        n: outward normal of the object there.
        depth: [m].
        side: 1 and -1 = of the finger at +y and -y, 0 = of the palm.
        slope: of the finger's height over its distance from the middle.
        dt: [s].
        pad: as of `march`.
    """
    stiff, tangent, damping, friction = pad[0], pad[1], pad[2], pad[3]
    moving = (0.0, side * state[FINGER_SPEED], abs(side) * slope * state[FINGER_SPEED])
    rel = _plus(_plus(_at(state, 7), 1.0, _cross(_at(state, 10), x)), -1.0, moving)
    sinking = _dot(rel, n)
    normal = max(0.0, stiff * depth + damping * sinking)
    rel = _plus(rel, -sinking, n)
    bent = _plus(_at(bristle), dt, rel)
    bent = _plus(bent, -_dot(bent, n), n)
    length, longest = np.sqrt(_dot(bent, bent)), friction * normal / tangent
    if length > longest:
        bent = _times(longest / length, bent)
    _put(bristle, 0, bent)
    rubbing = _plus(_times(-tangent, bent), -damping, rel)
    share = min(1.0, friction * normal / max(np.sqrt(_dot(rubbing, rubbing)), 1e-30))
    force = _plus(_times(share, rubbing), -normal, n)
    _put(sums, 0, _plus(_at(sums), 1.0, _cross(x, force)))
    _put(sums, 3, _plus(_at(sums, 3), 1.0, force))
    sums[6] -= side * force[1] + abs(side) * slope * force[2]
    sums[7] += 0.5 * stiff * depth**2 + 0.5 * tangent * _dot(bent, bent)
    if side != 0.0:
        state[16 if side > 0.0 else 17] += normal


@njit(error_model="numpy")
def _lift(state: Array, arc: Array) -> float:
    """Put the pads at their height on an arc; return its slope over the finger's distance."""
    if arc[0] <= 0.0:
        return 0.0
    height = np.sqrt(arc[0] ** 2 - (state[FINGER] - arc[1]) ** 2)
    state[HEIGHT] = height - np.sqrt(arc[0] ** 2 - arc[1] ** 2)
    return (arc[1] - state[FINGER]) / height


@njit(error_model="numpy")
def _in_object(state: Array, R: Frame, sphere: Array) -> Vector:
    """Return where a finger's sphere (5,) is in the object's frame [m]."""
    opened = (0.0, sphere[4] * state[FINGER], state[HEIGHT])
    return _turn_back(R, _plus(_plus(_at(sphere), 1.0, opened), -1.0, _at(state)))


@njit(error_model="numpy")
def _list_met(
    state: Array, R: Frame, surface: Array, boxes: Array, sides: Array, box: Array, met: Rows
) -> int:
    """List point and box of what is near enough to be looked at; return how many there are."""
    meets = 0
    for m in range(len(surface)):
        place = _plus(_at(state), 1.0, _turn(R, _at(surface[m])))
        for b in range(len(boxes)):
            _shift(boxes[b], float(sides[b]), state, box)
            if _below(place, box, _nearest(place, box)) > -SKIN_M:
                met[meets, 0], met[meets, 1] = m, b
                meets += 1
    return meets


@njit(error_model="numpy")
def _press_parts(  # noqa: PLR0913, PLR0917 - compiled code takes plain arrays
    state: Array, R: Frame, sums: Array, bristles: Array, depths: Array, points: Array,
    outwards: Array, side: float, slope: float, dt: float, pad: Array,
) -> None:  # fmt: skip
    """Add what a sphere does in each part (P,) that it is in, as `_sink` found it."""
    for p in range(len(depths)):
        if depths[p] <= 0.0:
            _put(bristles[p], 0, (0.0, 0.0, 0.0))
            continue
        n = _turn(R, _at(outwards[p]))
        # The force acts in the middle of the overlap.
        x = _plus(_turn(R, _at(points[p])), -0.5 * depths[p], n)
        _press(state, sums, bristles[p], x, n, depths[p], side, slope, dt, pad)
        state[DEEPEST] = max(state[DEEPEST], depths[p])


@njit(error_model="numpy")
def _press_box(  # noqa: PLR0913, PLR0917 - compiled code takes plain arrays
    state: Array, sums: Array, bristle: Array, x: Vector, box: Array, came: int, side: float,
    slope: float, dt: float, pad: Array,
) -> int:  # fmt: skip
    """Add what a point at x from the object's centre does in a box; return the face it came by."""
    place = _plus(_at(state), 1.0, x)
    face = _nearest(place, box)
    if _below(place, box, face) <= 0.0:
        _put(bristle, 0, (0.0, 0.0, 0.0))
        return face
    # Not the nearest face: a point that comes in beside an edge would be caught there.
    face = came if came >= 0 else face
    depth, toward = _below(place, box, face), -1.0 if face < 3 else 1.0
    n = (
        toward if face % 3 == 0 else 0.0,
        toward if face % 3 == 1 else 0.0,
        toward if face % 3 == 2 else 0.0,
    )
    x = _plus(x, -0.5 * depth, n)
    _press(state, sums, bristle, x, n, depth, side, slope, dt, pad)
    return came


@njit(error_model="numpy")
def _drive(
    state: Array, sums: Array, dt: float, force: float, gain: float, speed: float, mass: float
) -> None:
    """Move the fingers by the drive's force and the contacts'; they stop where they are closed."""
    drive = min(force, max(-force, gain * (-speed - state[FINGER_SPEED])))
    state[FINGER_SPEED] += dt * (sums[6] + 2.0 * drive) / mass
    state[FINGER] += dt * state[FINGER_SPEED]
    if state[FINGER] < 0.0:
        state[FINGER], state[FINGER_SPEED] = 0.0, max(0.0, state[FINGER_SPEED])


@njit(error_model="numpy")
def _step(
    state: Array, R: Frame, sums: Array, dt: float, drag: float, slope: float, matter: Array
) -> float:
    """Move the object, note the energy; return how far anything may have moved [m]."""
    at, v, w = _at(state), _at(state, 7), _at(state, 10)
    # Euler's equations about the principal axes.
    a, b, (ix, iy, iz) = _turn_back(R, w), _turn_back(R, _at(sums)), _at(matter, 1)
    spin = (
        a[0] + dt * (b[0] - (iz - iy) * a[1] * a[2]) / ix,
        a[1] + dt * (b[1] - (ix - iz) * a[2] * a[0]) / iy,
        a[2] + dt * (b[2] - (iy - ix) * a[0] * a[1]) / iz,
    )
    decay = 1.0 - drag * dt
    v = _times(decay, _plus(v, dt / matter[0], _at(sums, 3)))
    w = _times(decay, _turn(R, spin))
    _put(state, 0, _plus(at, dt, v))
    _put(state, 7, v)
    _put(state, 10, w)
    # q' = w q / 2, in quaternions.
    real, q = state[3], _at(state, 4)
    q = _plus(q, 0.5 * dt, _plus(_cross(w, q), real, w))
    real -= 0.5 * dt * _dot(w, _at(state, 4))
    state[3] = real / np.sqrt(real**2 + _dot(q, q))
    _put(state, 4, _times(1.0 / np.sqrt(real**2 + _dot(q, q)), q))
    state[ENERGY] = sums[7] + 0.5 * matter[4] * state[FINGER_SPEED] ** 2
    state[ENERGY] += 0.5 * matter[0] * _dot(v, v)
    state[ENERGY] += 0.5 * (ix * spin[0] ** 2 + iy * spin[1] ** 2 + iz * spin[2] ** 2)
    moved = dt * (np.sqrt(_dot(v, v)) + matter[5] * np.sqrt(_dot(w, w)))
    return moved + dt * (1.0 + abs(slope)) * abs(state[FINGER_SPEED])


@njit(error_model="numpy")
def march(  # noqa: PLR0913, PLR0917 - compiled code takes plain arrays
    state: Array, bristles: Array, bristles_box: Array, entered: Rows, wrenches: Array, inner: int,
    sample: int, dt: float, lost_m: float, seen: Array, drag: float, speed: float, matter: Array,
    pad: Array, spheres: Array, boxes: Array, sides: Array, triangles: Array, normals: Array,
    first: Rows, surface: Array, arc: Array,
) -> int:  # fmt: skip
    """Move a pair under loads; return how often it was looked at until the end, or it was lost.

    Args:
        state: (SIZE,) of the pair; changed.
        bristles: (S, P, 3) how far each sphere's are bent, hand axes [m]; changed.
        bristles_box: (N, B, 3) the same of each point's; changed.
        entered: (N, B) the face of each box that each point is in front of, or came in by; changed.
        wrenches: (T, 6) torque and force on the object, hand axes.
        inner: steps for which each stands.
        sample: loads between two looks.
        dt: [s].
        lost_m: an object that moved farther is lost [m].
        seen: (L, SIZE) states at the looks; filled.
        drag: rate at which the object's speeds decay [1/s].
        speed: of closing [m/s].
        matter: (6,) mass of the object [kg], its moments [kg m^2], mass of both fingers [kg], and
            the object's greatest distance from its centre [m].
        pad: (5,) a sphere's stiffness, its bristles' [N/m], damping [N s/m], friction, force [N].
        spheres: (S, 5) centre and radius of each [m], hand closed, and its finger: 1 at +y, or -1.
        boxes: (B, 2, 3) low and high corner of each box of the hand, hand closed [m].
        sides: (B,) its finger: 1 at +y, -1 at -y, 0 = the palm's.
        triangles: (T, 3, 3) corners of all parts [m].
        normals: (T, 4) outward unit normal n and d of each: n . x + d <= 0 inside [m].
        first: (P + 1,) where each part begins.
        surface: (N, 3) points of the object's surface [m].
        arc: (2,) radius and y of the axis of fingers on an arc [m]; radius 0 = they slide.
    """
    count, parts = len(spheres), len(first) - 1
    near, counts = np.zeros((count, len(triangles)), np.int64), np.zeros((count, parts), np.int64)
    depths, points, outwards = np.zeros(parts), np.zeros((parts, 3)), np.zeros((parts, 3))
    met, meets = np.zeros((len(surface) * len(boxes), 2), np.int64), 0
    box, sums = np.zeros((2, 3)), np.zeros(8)
    start, moved, looks, gain = _at(state), np.inf, 0, 10.0 * pad[4] / speed
    for load in range(len(wrenches)):
        for _ in range(inner):
            R = _rotation(state[3], state[4], state[5], state[6])
            slope = _lift(state, arc)
            for i in range(6):
                sums[i] = wrenches[load, i]
            sums[6] = sums[7] = state[16] = state[17] = 0.0
            fresh = moved > SKIN_M
            if fresh:
                moved, meets = 0.0, _list_met(state, R, surface, boxes, sides, box, met)
            for s in range(count):
                center = _in_object(state, R, spheres[s])
                if fresh:
                    reach = spheres[s, 3] + SKIN_M
                    _list_near(center, reach, triangles, first, near[s], counts[s])
                _sink(
                    center, spheres[s, 3], triangles, normals, first, near[s], counts[s],
                    depths, points, outwards,
                )  # fmt: skip
                side = spheres[s, 4]
                _press_parts(
                    state, R, sums, bristles[s], depths, points, outwards, side, slope, dt, pad
                )
            for k in range(meets):
                m, b = met[k, 0], met[k, 1]
                side, x = float(sides[b]), _turn(R, _at(surface[m]))
                _shift(boxes[b], side, state, box)
                came = int(entered[m, b])
                entered[m, b] = _press_box(
                    state, sums, bristles_box[m, b], x, box, came, side, slope, dt, pad
                )
            _drive(state, sums, dt, pad[4], gain, speed, matter[4])
            moved += _step(state, R, sums, dt, drag, slope, matter)
        if (load + 1) % sample == 0 or load + 1 == len(wrenches):
            for i in range(SIZE):
                seen[looks, i] = state[i]
            looks += 1
            shift = _plus(_at(state), -1.0, start)
            if not _dot(shift, shift) <= lost_m * lost_m:
                break
    return looks
