"""How symmetries are sought and judged."""

from dataclasses import dataclass

from realsim.errors import InputError


@dataclass(frozen=True, kw_only=True, slots=True)
class SymmetryConfig:
    """How symmetries are sought and judged; lengths are shares of the object's diameter."""

    tolerance: float = 0.01
    """Greatest distance of the moved surface from the surface [share of the diameter]: 1 %, 1.3 mm
    of a 13 cm object, what a depth camera still sees. `outliers` of the surface may exceed it."""
    greatest_tolerance: float = 0.034
    """The tolerance of a distorted mesh [share of the diameter]. A smooth shape error of 1 % RMS
    moves true symmetries of the 20 shipped parts by up to 3.3 %; the half turns of a potted meat
    can that are none are off by 3.5 %. Of a scan whose own error is known less, give less: a
    bulging cracker box is 2.4 % (6.5 mm) off its half turns, as a distorted box is."""
    noise_factor: float = 4.5
    """How distorted a mesh is, is judged from the motion (turn or mirror) that fits it best: the
    tolerance is so many times its worst distance, between the two above. An exact mesh is thus
    judged strictly, and a distorted one by its own measure. With 1 % RMS shape error a whole group
    is off by up to 4.2 times what its best motion is."""
    rms_tolerance: float = 0.012
    """Greatest RMS distance [share of the diameter]: 1 % shape error gives up to 0.85 % for one
    motion and a little more for a whole group; of the motions of the shipped parts that are no
    symmetries the nearest, a flange turned by half a bore, has 1.43 %."""
    outliers: float = 0.005
    """Share of the surface that the worst distance leaves out: spikes and gaps of a scan, and a
    small feature. A hole of 8 mm through a bowl's wall is 0.4 % of its surface and leaves it its
    axis, as BOP's bowls with their marks have theirs; one of twice the share breaks it."""
    orders: int = 24
    """Greatest order of an axis that is told from a continuous one; a gear has its teeth."""
    continuous_step_deg: float = 5.0
    """Step at which a continuous symmetry is judged [deg]; no order up to 36 hides in it."""
    directions: int = 600
    """Directions of the half sphere that are tried as axes: 6 deg apart, so every axis is within
    4 deg of one, from where the least squares converge."""
    screening_points: int = 150
    """Surface points by which directions are ranked."""
    fitting_points: int = 300
    """Surface points by which an axis is refined."""
    judging_points: int = 1500
    """Surface points by which a symmetry is judged, by exact distances."""
    near_share: float = 0.7
    """A refused motion is reported from this share of the surface on that it maps onto it."""
    near_distance: float = 0.015
    """The motion maps it onto itself within this distance [share of the diameter]: 2 mm of a 13 cm
    object."""
    near_reported: int = 8
    """Axes of refused motions that are reported: a person reads them."""
    color_difference: float = 12.0
    """Mean difference of the colours of points that a symmetry swaps from which on the texture
    breaks it [grey levels of 255], beyond what neighbouring points differ by."""
    seed: int = 0
    """Seed of the surface points."""

    def __post_init__(self) -> None:
        """Check the tolerances."""
        if not 0 < self.tolerance <= self.greatest_tolerance < 0.2:
            raise InputError(
                f"the tolerances {self.tolerance:g} and {self.greatest_tolerance:g} are shares of "
                "the diameter; 0 < tolerance <= greatest_tolerance < 0.2 is needed (0.01 and "
                "0.03). Were millimetres given?"
            )
        if self.orders < 2:
            raise InputError(
                f"orders up to {self.orders} hold no symmetry; ask for 2 or more (24)."
            )
