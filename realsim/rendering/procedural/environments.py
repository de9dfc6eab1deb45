"""Any surroundings at random: a sky outside or a room inside, exposed as a camera would."""

import numpy as np

from realsim.rendering.appearance import Environment
from realsim.rendering.procedural.light import balanced, exposed
from realsim.rendering.procedural.rooms import room
from realsim.rendering.procedural.skies import overcast_sky, sunny_sky


def random_environment(rng: np.random.Generator) -> Environment:
    """Return a clear, clouded or overcast sky, a golden hour, or a room.

    Rooms are drawn half of the time, because robots stand in them. White is balanced by most of
    the way, as cameras do, and the exposure shows a grey card that lies flat as mid-grey.

    Args:
        rng: decides on everything; the same state gives the same bytes.
    """
    kind = rng.random()
    if kind < 0.5:
        made = room(rng)
    elif kind < 0.65:
        made = overcast_sky(rng)
    elif kind < 0.8:
        made = sunny_sky(rng, rng.uniform(3.0, 12.0), rng.uniform(2.2, 5.0),
                         float(rng.choice([0.0, rng.uniform(0.1, 0.4)])))  # fmt: skip
    else:
        made = sunny_sky(rng, rng.uniform(15.0, 70.0), rng.uniform(2.2, 6.0),
                         float(rng.choice([0.0, rng.uniform(0.15, 0.7)])))  # fmt: skip
    return exposed(balanced(made, float(rng.uniform(0.5, 0.95))))
