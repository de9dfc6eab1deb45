"""Photoreal pictures on the labels' pixel grid (extra `photo`: Mitsuba 3, Open Image Denoise)."""

from realsim.rendering.photoreal.llvm_probe import LlvmSearch, find_llvm
from realsim.rendering.photoreal.renderer import FirstHits, PhotorealConfig, PhotorealRenderer

__all__ = ["FirstHits", "LlvmSearch", "PhotorealConfig", "PhotorealRenderer", "find_llvm"]
