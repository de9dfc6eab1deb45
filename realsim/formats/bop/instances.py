"""Which rows of different images are the same thing: BOP has no numbers for it.

An object that no image shows twice is one thing. Where alike ones stand together, they are told
apart by where they are in the world, which needs camera poses: positions agree within a gate that
is far less than their distance from each other. A turn by a symmetry keeps the origin of an object
whose axes go through it, so symmetries need no thought. What is ambiguous stays without a number.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array

Json = dict[str, Any]
INSTANCE = "instance"
"""Key, ours, of a row of scene_gt.json: equal numbers in one scene are one thing. It is written for
sources that know it, and believed where every row has it."""
GATE_M = 0.02
"""Positions of one thing in several images agree within this [m]: labels and camera poses of public
data sets are good to some millimetres."""
GATE_SHARE = 0.4
"""They agree within this share of the least distance of two alike, too: less than half decides."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Instances:
    """Numbers of things, and of which objects there are none."""

    numbers: Mapping[int, tuple[int | None, ...]]
    """Image -> one number per row."""
    ambiguous: tuple[int, ...]
    """Object ids whose instances could not be told apart."""


def stated_instances(rows: Mapping[int, Sequence[Json]]) -> dict[int, tuple[int, ...]] | None:
    """Return the numbers that the rows of every image have; None where one lacks it.

    None, too, where a number is twice in one image, or is of two objects.
    """
    found: dict[int, tuple[int, ...]] = {}
    object_of: dict[int, int] = {}
    for index, listed in rows.items():
        numbers = [row.get(INSTANCE) for row in listed]
        whole = tuple(n for n in numbers if type(n) is int and n >= 0)
        if len(whole) < len(numbers) or len(set(whole)) < len(whole):
            return None
        for n, row in zip(whole, listed, strict=True):
            if object_of.setdefault(n, row["obj_id"]) != row["obj_id"]:
                return None
        found[index] = whole
    return found


def tell_apart(
    obj_ids: Mapping[int, Sequence[int]], positions: Mapping[int, Array | None]
) -> Instances:
    """Return a number for every row: equal numbers are one thing.

    Args:
        obj_ids: image -> object id of each row.
        positions: image -> (K, 3) of each row in world [m]; None = no camera pose.
    """
    all_ids = sorted({i for ids in obj_ids.values() for i in ids})
    found: dict[int, list[int | None]] = {index: [None] * len(v) for index, v in obj_ids.items()}
    ambiguous: list[int] = []
    number = 0
    for obj_id in all_ids:
        rows = {
            index: [k for k, i in enumerate(ids) if i == obj_id]
            for index, ids in obj_ids.items()
            if obj_id in ids
        }
        tracks = _tracks(rows, positions)
        if tracks is None:
            ambiguous.append(obj_id)
            continue
        for index, places in tracks.items():
            for k, track in places.items():
                found[index][k] = number + track
        number += 1 + max(track for places in tracks.values() for track in places.values())
    numbers = {index: tuple(v) for index, v in found.items()}
    return Instances(numbers=numbers, ambiguous=tuple(ambiguous))


def _tracks(
    rows: Mapping[int, Sequence[int]], positions: Mapping[int, Array | None]
) -> dict[int, dict[int, int]] | None:
    """Return image -> row -> number of the thing, from 0, of one object; None = ambiguous."""
    most = max(len(k) for k in rows.values())
    if most == 1:
        return {index: {places[0]: 0} for index, places in rows.items()}
    if len(rows) == 1:
        return {index: {k: n for n, k in enumerate(places)} for index, places in rows.items()}
    points: dict[int, Array] = {}
    for index, places in rows.items():
        world = positions.get(index)
        if world is None:
            return None
        points[index] = world[list(places)]
    gate = min(GATE_M, GATE_SHARE * min(_least_distance(p) for p in points.values()))
    seed = max(rows, key=lambda index: len(rows[index]))
    things = points[seed]
    matched: dict[int, dict[int, int]] = {}
    for index, places in rows.items():
        distance = np.linalg.norm(points[index][:, None] - things[None], axis=-1)
        nearest = distance.argmin(axis=1)
        if np.any(distance.min(axis=1) > gate) or len(set(nearest.tolist())) < len(places):
            return None
        matched[index] = {k: int(n) for k, n in zip(places, nearest, strict=True)}
    return matched


def _least_distance(points: Array) -> float:
    if len(points) < 2:
        return np.inf
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    return float(distance[np.triu_indices(len(points), 1)].min())
