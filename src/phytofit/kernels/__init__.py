"""Numba kernels: arrays in, arrays out; no settings, no files, no random state, no units.

All are serial and release the GIL, so that callers may run them on threads of their own.
"""
