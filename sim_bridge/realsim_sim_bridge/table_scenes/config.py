"""Settings of generated table scenes: how many objects, how large, how they fall, how they rest."""

import math
from dataclasses import dataclass, field

from realsim.errors import InputError
from realsim_sim_bridge.table_scenes.table_shapes import table_names


@dataclass(frozen=True, kw_only=True, slots=True)
class PoolConfig:
    """Which meshes of a pool are used."""

    most_mb: float = 60.0
    """Larger files are skipped [MB]: reading them takes longer than rendering a view."""
    most_faces: int = 200_000
    """Meshes of more triangles are skipped: fifteen of them would fill the memory of a worker."""
    least_flatness: float = 0.02
    """Meshes whose least width is a smaller share of their largest extent are skipped: sheets,
    which the physics can neither stack nor hold."""
    keep_size: bool = False
    """Whether objects keep the size they have in their files (known objects) instead of a random
    one."""
    unit: str | None = None
    """What one unit of a folder's mesh files is ('m', 'mm', ...); needed where sizes are kept."""
    hull_only: bool = False
    """Whether the hull stands for meshes without known convex parts: quick, but no hollow."""
    tries: int = 40
    """Number of unusable meshes in a row that are skipped before the pool is refused."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DropConfig:
    """How objects fall on the table and when they rest."""

    fall_m: tuple[float, float] = (0.20, 0.40)
    """Height of an object's lowest point over the table, or over what lies below it, when it is let
    go [m]; the paper's."""
    spread: float = 0.30
    """Objects are let go over a disc of this share of the table's shorter side [radius / side]:
    fifteen of them then touch and lean on each other, as in the paper's figures."""
    wave: int = 3
    """Objects let go at a time."""
    wave_s: float = 0.6
    """Time until the next are let go [s]: a fall from 40 cm takes 0.29."""
    friction: float = 0.5
    """Coulomb coefficient while objects fall (wood on wood 0.4, plastics 0.3 to 0.5): rougher ones
    would stand on edges."""
    rate_hz: float = 240.0
    """Steps per second while objects fall."""
    iterations: int = 60
    """Solver iterations a step while objects fall."""
    rest_rate_hz: float = 480.0
    """Steps per second while objects come to rest; the Robot School's."""
    rest_iterations: int = 300
    """Solver iterations a step while objects come to rest; the Robot School's."""
    margin_m: float = 0.0005
    """Bullet's skin, for which hulls are drawn in [m]; the Robot School's."""
    rolling: float = 0.002
    """Rolling and spinning friction while objects fall [m]: balls come to rest within 2 s. None
    acts when it is checked whether they stay."""
    longest_s: float = 6.0
    """Simulated time after the last object was let go, at most [s]; what still moves is named."""
    rest_m_s: float = 0.002
    """Centres of mass slower than this rest [m/s]; the Robot School's."""
    rest_rad_s: float = 0.02
    """Greatest turning speed of an object at rest [rad/s]."""
    rest_s: float = 0.25
    """Rest has to last so long [s]."""
    check_s: float = 1.0
    """Time of the second settle, from the final poses in a fresh world [s]."""
    stays_m: float = 0.0005
    """Greatest way of any point in the second settle [m]: half of the millimetre that is promised,
    since another machine rounds otherwise."""
    rounds: int = 4
    """Second settles that are tried with all objects; then the one that moves most is taken out."""
    edge_m: float = 0.0
    """No point of an object is nearer to the rim of the table than this [m]; those that hang over
    are taken off and counted, since nothing holds them when they are touched."""
    tries: float = 2.0
    """Objects let go at most, as a multiple of those wanted: some fall off."""

    def __post_init__(self) -> None:
        """Check what would make the physics meaningless.

        Raises:
            InputError: a height, a rate, a time or a coefficient that cannot be.
        """
        low, high = self.fall_m
        if not (0 < low <= high <= 2.0):
            raise InputError(
                f"objects are let go {low} to {high} m over the table; 0 < least <= most <= 2 m is "
                "accepted (0.2 and 0.4)."
            )
        if not (math.isfinite(self.friction) and 0 < self.friction <= 10):
            raise InputError(f"the friction is {self.friction}; above 0 and up to 10 is accepted.")
        if min(self.rate_hz, self.rest_rate_hz) < 60 or min(self.iterations, self.wave) < 1:
            raise InputError("at least 60 steps a second, 1 iteration and 1 object are needed.")
        if not 0 < self.spread <= 0.5:
            raise InputError(
                f"objects are spread over {self.spread} of the table's shorter side; above 0 and "
                "up to 0.5 (the whole table) is accepted."
            )


@dataclass(frozen=True, kw_only=True, slots=True)
class TableSceneConfig:
    """What a generated scene is."""

    objects: tuple[int, int] = (10, 20)
    """Least and greatest number of objects; the paper's."""
    sizes: tuple[float, float] = (0.02, 0.20)
    """Largest extent of an object as a share of the table's longer side; the paper's."""
    tables: tuple[str, ...] = ()
    """Names of the table models to choose from; empty = all ten."""
    walls: float = 0.5
    """Share of the scenes that stand in a room with walls; the others see the sky all around."""
    density: float = 1000.0
    """Density of every object [kg/m^3]; the paper's."""
    pool: PoolConfig = field(default_factory=PoolConfig)
    drop: DropConfig = field(default_factory=DropConfig)

    def __post_init__(self) -> None:
        """Check counts, sizes and tables.

        Raises:
            InputError: numbers that cannot be.
        """
        few, many = self.objects
        if not 1 <= few <= many <= 100:
            raise InputError(
                f"{few} to {many} objects a scene; 1 <= least <= most <= 100 is accepted (10-20)."
            )
        small, large = self.sizes
        if not 0.005 <= small <= large <= 0.5:
            raise InputError(
                f"objects of {small:g} to {large:g} of the table's side; shares from 0.005 to 0.5 "
                "are accepted (0.02 and 0.20)."
            )
        strangers = sorted(set(self.tables) - set(table_names()))
        if strangers:
            raise InputError(
                f"there is no table '{strangers[0]}'; the tables are: {', '.join(table_names())}."
            )
        if not 0 <= self.walls <= 1:
            raise InputError(f"{self.walls} of the scenes with walls; 0 to 1 is accepted.")
        if not 20 <= self.density <= 20000:
            raise InputError(
                f"a density of {self.density:g} kg/m^3; 20 (foam) to 20000 (tungsten) is accepted."
            )
