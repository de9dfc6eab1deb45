"""Photoreal pictures on the labels' pixel grid (extra `photo`: Mitsuba 3, Open Image Denoise)."""

from realsim.rendering.photoreal.renderer import FirstHits, PhotorealConfig, PhotorealRenderer
from realsim.rendering.photoreal.variant import LlvmSearch, find_llvm

__all__ = ["FirstHits", "LlvmSearch", "PhotorealConfig", "PhotorealRenderer", "find_llvm"]
