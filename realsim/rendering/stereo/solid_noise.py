"""Micro texture: noise that fills space, band-limited to what the pixels can resolve.

It is fixed to the object, so that both eyes see the same grain. Every octave is the same periodic
block of noise at twice the size; finer ones than the pixels resolve are left out, or they would
alias differently in the two eyes, and coarser ones match nothing. Like natural surfaces it has the
same contrast at every octave, so at every distance (Field, JOSA A 1987).
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

BLOCK = 64
"""Edge of the periodic block [cells], a power of two: 45 px or more. The block is turned against
the object, so that a row of pixels runs askew through it and does not repeat."""
FINEST_CELL_M = 2e-5
"""Cell of the finest octave [m]: a hundredth of a pixel at arm's length."""
NOISE_STEPS = 32
"""Standard deviation of the block [counts]: four of them before it is clipped."""
CELLS_PER_PIXEL = 0.70
"""The finest octave shown has cells of at least this many pixels and ends there: its waves are 4 to
8 cells, so 2.8 px or longer."""

FIRST_OCTAVE = float(np.log2(CELLS_PER_PIXEL / FINEST_CELL_M))
"""Octave shown by pixels of 1 m."""


@lru_cache(maxsize=1)
def noise_block() -> NDArray[np.int8]:
    """Return (BLOCK, BLOCK, BLOCK) periodic noise, mean 0, sd NOISE_STEPS.

    It holds waves of 4 to 8 cells only, which trilinear interpolation keeps.
    """
    rng = np.random.default_rng(20)
    spectrum = np.fft.rfftn(rng.standard_normal((BLOCK,) * 3))
    k = np.fft.fftfreq(BLOCK)
    last = np.fft.rfftfreq(BLOCK)
    radius = np.sqrt(k[:, None, None] ** 2 + k[None, :, None] ** 2 + last[None, None, :] ** 2)
    spectrum *= (radius >= 1 / 8) & (radius <= 1 / 4)
    noise = np.fft.irfftn(spectrum, s=(BLOCK,) * 3, axes=(0, 1, 2))
    # Bytes: the whole block stays in the processor's second cache.
    block = np.clip(np.round(noise * (NOISE_STEPS / noise.std())), -127, 127).astype(np.int8)
    block.setflags(write=False)
    return block


@lru_cache(maxsize=1)
def packed_noise() -> NDArray[np.int32]:
    """Return the block (BLOCK^3,) with four neighbours in every number.

    The bytes of (i, j, k), from the lowest, are the noise + 128 at (j, k), (j, k + 1), (j + 1, k)
    and (j + 1, k + 1): interpolation reads two numbers in place of eight.
    """
    shifted = (noise_block().astype(np.int16) + 128).astype(np.uint32)
    after = np.roll(shifted, -1, axis=2)
    packed = shifted | (after << 8)
    packed |= (np.roll(shifted, -1, axis=1) << 16) | (np.roll(after, -1, axis=1) << 24)
    flat = packed.view(np.int32).ravel()
    flat.setflags(write=False)
    return flat


@lru_cache(maxsize=1)
def block_axes() -> NDArray[np.float64]:
    """Return the rotation (3, 3) of the block against the object: no plane of it is aligned."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec([0.61, -0.43, 1.07]).as_matrix()
